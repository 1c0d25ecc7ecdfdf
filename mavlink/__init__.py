"""MAVLink: bytes into vehicle state, commands into calls; independent of recon."""
