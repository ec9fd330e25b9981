"""Processes and clusters that compute independent jobs."""
