"""Finished flights: their keyframes adjusted with surveyed points, and scans of one site."""
