"""The backup filter: an input is allowed if a backup law keeps the system safe after it."""

from safe_envs.wrappers.backup.backup_filter import BackupFilter
from safe_envs.wrappers.backup.settings import BackupSettings

__all__ = ["BackupFilter", "BackupSettings"]
