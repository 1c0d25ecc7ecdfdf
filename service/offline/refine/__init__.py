"""A finished scan adjusted as a whole, and what to fly again."""
