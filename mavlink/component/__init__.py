"""What we are on the network: the onboard computer and the camera."""
