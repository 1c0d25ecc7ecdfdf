"""The onboard computer and the camera that this service is on the MAVLink network."""
