"""A filter as C99 for somebody's control loop, and its comparison with the filter in Python."""

from safe_envs.export.comparison import CComparison, compare
from safe_envs.export.export import ExportOptions, export_filter

__all__ = ["CComparison", "ExportOptions", "compare", "export_filter"]
