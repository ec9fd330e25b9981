"""Gymnasium wrappers: the safety filter, monitors of third-party envs, and the cost in the return
of `step`.
"""
