"""Products of a finished cloud: rasters, coverage, mesh, texture."""
