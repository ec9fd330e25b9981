"""Compiled programs: kernels in plain Python, linked with the formulas of a problem."""
