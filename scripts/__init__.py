"""What a person runs: the `safe-envs` command."""
