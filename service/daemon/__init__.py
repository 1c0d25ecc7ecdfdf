"""The service that flies: it scans on command, watches itself and its machine."""
