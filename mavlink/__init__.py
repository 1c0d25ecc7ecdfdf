"""MAVLink: bytes into vehicle state, commands into calls; knows nothing of recon."""
