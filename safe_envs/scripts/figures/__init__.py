"""Pictures of results, and films."""
