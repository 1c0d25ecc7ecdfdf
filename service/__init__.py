"""Everything with side effects: cameras, files, datalink, commands; joins recon and mavlink."""
