"""Where all keyframes are: vision, attitude, altitude, GNSS and loops in one graph."""
