"""Two frames as the pictures of a virtual stereo camera, to a depth map with its sigma."""
