"""One-step data of a system, and their collection."""
