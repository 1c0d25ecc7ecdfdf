"""Choice of the backend, and sharing of cores between threads."""
