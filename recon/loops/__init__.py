"""Places seen again: candidates, and the proof that they are the same."""
