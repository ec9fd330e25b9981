"""Evaluations over a grid of settings, read from one file."""
