"""Numbers, shares and states as texts."""

from __future__ import annotations

import math

import numpy as np

from safe_envs.agents.evaluation.rate_text import percent
from safe_envs.problem.problem import SafetyProblem

_NOTHING = 1e-6
"""Accuracy of a coordinate of a state found by a search, in parts of the workspace."""

_ROUNDING = 1e-8


def state_text(problem: SafetyProblem, x: np.ndarray) -> str:
    """Return a state as "(x = 1, v = 0.5)".

    Args:
        problem: with the names of the states and the workspace.
        x: shape (n,).

    Returns:
        Coordinates with three digits; those that are 0 up to the accuracy of a search as 0.
    """
    parts = []
    for s, value in zip(problem.states, x.tolist(), strict=True):
        width = s.high - s.low if math.isfinite(s.high - s.low) else 1.0
        parts.append(f"{s.symbol} = {value if abs(value) > _NOTHING * width else 0.0:.3g}")
    return f"({', '.join(parts)})"


def number_text(value: float) -> str:
    """Return a number with five digits, or "infinite"."""
    return "infinite" if math.isinf(value) else f"{value:.5g}"


def size_text(count: int) -> str:
    """Return a number of bytes with its unit."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"


def share_text(share: float | None) -> str:
    """Return a share in per cent, with two digits below 1 %, so that it does not read as 0."""
    if share is None or share == 0.0 or share >= 0.01:
        return percent(share)
    return f"{100 * share:.2g} %"


def relative_text(share: float) -> str:
    """Return a relative error in per cent with two digits; below the rounding error, its bound."""
    if share < _ROUNDING:
        return f"< {100 * _ROUNDING:g} %"
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"
