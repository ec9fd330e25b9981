"""Features, networks and files of learned models."""
