"""Which input is allowed: conditions, QPs, the safety filter, what it learns and estimates."""
