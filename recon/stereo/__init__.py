"""Two frames as the images of a virtual stereo camera, to a depth map with its sigma."""
