"""What touches the world: cameras, files, the datalink, the command line; joins recon and mavlink."""
