"""Training of Stable-Baselines3 agents with a filter in the loop."""
