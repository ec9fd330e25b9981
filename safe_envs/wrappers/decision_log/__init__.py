"""What a filter decided in a control loop: kept cheaply, written to a file, read back."""

from safe_envs.wrappers.decision_log.columns import LogColumns
from safe_envs.wrappers.decision_log.log import DecisionLog

__all__ = ["DecisionLog", "LogColumns"]
