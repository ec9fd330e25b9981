"""A filter as C99 for somebody's control loop, and its comparison with the filter in Python."""

from safe_envs.export.comparison import CComparison, compare
from safe_envs.export.export import ExportOptions, export_filter
from safe_envs.export.promise_comparison import PromiseComparison, compare_promise
from safe_envs.export.promise_export import export_promise

__all__ = [
    "CComparison",
    "ExportOptions",
    "PromiseComparison",
    "compare",
    "compare_promise",
    "export_filter",
    "export_promise",
]
