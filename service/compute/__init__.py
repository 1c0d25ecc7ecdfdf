"""What computes: the backend that is chosen, and how threads share the cores."""
