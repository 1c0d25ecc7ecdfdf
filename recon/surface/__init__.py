"""What is made of a finished cloud: rasters, coverage, mesh, texture."""
