"""Gymnasium wrappers: safety filters, monitors of third-party envs, costs returned by `step`."""
