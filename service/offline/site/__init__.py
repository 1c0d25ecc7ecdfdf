"""Several scans as one site: gathered into one store, aligned, compared."""
