"""Refinement and exports of a finished scan."""
