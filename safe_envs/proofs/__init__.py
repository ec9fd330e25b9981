"""Bounds on the probability of safety, their assumptions, and where a condition can be met."""
