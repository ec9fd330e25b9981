"""One constraint on two inputs: a few formulas."""

from __future__ import annotations

ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.wrappers.qp.rounding`, 16 eps."""
SMALL_SQUARE = 1e-200
"""The square of a constraint that is smaller may vanish on the way,"""
LARGE_SQUARE = 1e200
"""and one that is larger may overflow."""
FAR_OFF = 1e3
"""How many widths of the input bounds a proposal may be off: rounding grows with them."""


def project_two_inputs(  # noqa: PLR0913
    a1: float,
    a2: float,
    b: float,
    v1: float,
    v2: float,
    low1: float,
    low2: float,
    high1: float,
    high2: float,
    w1: float,
    w2: float,
) -> tuple[bool, float, float, float, bool]:
    """Project two inputs onto a_1 u_1 + a_2 u_2 + b >= 0.

    Args:
        a1: coefficient of the first input.
        a2: coefficient of the second input.
        b: offset.
        v1: first proposed input.
        v2: second proposed input.
        low1: lower bound of the first input.
        low2: lower bound of the second input.
        high1: upper bound of the first input.
        high2: upper bound of the second input.
        w1: positive weight of the first input.
        w2: positive weight of the second input.

    Returns:
        Whether the QP is solved, the inputs, the margin, and whether the constraint had to act. It
        is not solved where the constraint cannot be met, a proposal is far off, or sizes ask for
        care.
    """
    c1 = low1 if v1 < low1 else high1 if v1 > high1 else v1
    c2 = low2 if v2 < low2 else high2 if v2 > high2 else v2
    margin = a1 * c1 + a2 * c2 + b
    if margin >= 0.0:
        return True, c1, c2, margin, False
    off1, off2 = abs(v1 - c1), abs(v2 - c2)
    if not (off1 <= FAR_OFF * (high1 - low1) and off2 <= FAR_OFF * (high2 - low2)):
        return False, v1, v2, margin, True
    inside = off1 == 0.0 and off2 == 0.0
    if not inside:
        margin = a1 * v1 + a2 * v2 + b
    d1, d2 = a1 / w1, a2 / w2
    slope = a1 * d1 + a2 * d2
    if not SMALL_SQUARE < slope < LARGE_SQUARE:
        return False, v1, v2, margin, True
    step = margin / slope
    u1, u2 = v1 - step * d1, v2 - step * d2
    if not (low1 <= u1 <= high1 and low2 <= u2 <= high2):
        if d1 == 0.0 or d2 == 0.0:
            return False, v1, v2, margin, True
        end1 = high1 if d1 > 0.0 else low1
        end2 = high2 if d2 > 0.0 else low2
        if not inside:
            # The end of the constraint's edge within the bounds that is nearest: the way along the
            # edge leads into the bounds of one input, and then into those of the other.
            if not low1 <= u1 <= high1:
                u1 = low1 if u1 < low1 else high1
                u2 = -(b + a1 * u1) / a2
            if not low2 <= u2 <= high2:
                u2 = low2 if u2 < low2 else high2
                u1 = -(b + a2 * u2) / a1
        # One stops at its bound, and the other goes on alone.
        elif (end1 - v1) / d1 < (end2 - v2) / d2:
            u1, u2 = end1, -(b + a1 * end1) / a2
        else:
            u1, u2 = -(b + a2 * end2) / a1, end2
        if not (low1 <= u1 <= high1 and low2 <= u2 <= high2):
            return False, v1, v2, margin, True
    first, second = a1 * u1, a2 * u2
    margin = first + second + b
    allowed = ROUNDING * abs(b) + ROUNDING * abs(first) + ROUNDING * abs(second)
    return -allowed <= margin <= allowed, u1, u2, margin, True
