"""Checks for authors of systems, conditions and policies, as `check_env` is for envs.

Each check raises an `AssertionError` that names the property that does not hold.
"""
