"""From camera frames to a map, a store and a datalink: the path that flies."""
