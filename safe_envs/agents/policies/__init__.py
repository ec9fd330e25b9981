"""Policies with the `predict` of Stable-Baselines3."""
