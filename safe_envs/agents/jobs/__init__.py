"""The one runner of independent jobs, and the one store of their results."""
