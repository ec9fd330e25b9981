"""Which input is allowed: conditions, their QPs, the safety filter, what it learns and estimates."""
