"""Checks for authors of conditions, policies and systems, as Gymnasium's `check_env` is for envs.

Each raises an `AssertionError` that names the property that does not hold.
"""

from safe_envs.testing.condition import check_condition
from safe_envs.testing.policy import check_policy
from safe_envs.testing.system import check_system

__all__ = ["check_condition", "check_policy", "check_system"]
