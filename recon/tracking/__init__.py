"""From one frame to the next: corners, matches, poses, keyframes."""
