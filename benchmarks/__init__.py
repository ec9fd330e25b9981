"""The speed of filters, envs, learning and commands: `python -m benchmarks`."""
