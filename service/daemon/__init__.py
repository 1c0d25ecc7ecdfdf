"""The onboard service: scans on command, monitors itself and its machine."""
