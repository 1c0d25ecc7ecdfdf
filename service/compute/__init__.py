"""Choice of the backend."""
