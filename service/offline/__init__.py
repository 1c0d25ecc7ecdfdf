"""What is made of a finished scan: refinement and exports."""
