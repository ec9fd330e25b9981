"""Shares the command line with its tests."""

from tests.scripts.conftest import safe_envs_command

__all__ = ["safe_envs_command"]
