"""Which constraint of one state changes the proposed input most."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import mul, truediv
from typing import Any


def furthest_active(
    a: Sequence[Sequence[float]],
    b: Sequence[float],
    u: Sequence[float],
    active: Sequence[bool],
    weights: Sequence[float],
) -> int:
    """Return the active constraint whose half-space is furthest from the proposed input, else -1.

    One that says nothing of the input is nearer than any; of several such, the first counts.

    Args:
        a: coefficients of k constraints on m inputs.
        b: their offsets.
        u: the proposed input.
        active: which constraints are active.
        weights: of the inputs.
    """
    acting = [i for i, acts in enumerate(active) if acts]
    if len(acting) < 2:
        return acting[0] if acting else -1
    cause, furthest = acting[0], -math.inf
    for i in acting:
        if not any(a[i]):
            continue
        unit = max(map(abs, a[i]))  # so that squares neither overflow nor vanish
        parts = [aj / unit for aj in a[i]]
        square = sum(map(truediv, map(mul, parts, parts), weights))
        distance = -(sum(map(mul, a[i], u)) + b[i]) / unit / square**0.5
        if distance > furthest:
            cause, furthest = i, distance
    return cause


def dot(a: Sequence[Any], u: Sequence[Any]) -> Any:
    """Return a . u.

    Args:
        a: m entries, floats or arrays (B,).
        u: m entries, likewise.
    """
    return sum([aj * uj for aj, uj in zip(a, u, strict=True)])
