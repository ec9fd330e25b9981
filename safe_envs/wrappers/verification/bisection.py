"""Where boxes are bisected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.dynamics.first_order_forms import Form


def axis_of(
    low: np.ndarray,
    high: np.ndarray,
    width: np.ndarray,
    forms: Sequence[Form],
    chosen: np.ndarray,
) -> np.ndarray:
    """Return the axis along which forms vary most on each box, shape (B,).

    Args:
        low: lower ends of the boxes, shape (n, B).
        high: upper ends, shape (n, B).
        width: of the whole box, by which widths are compared, shape (n,).
        forms: on these boxes and others.
        chosen: which of those the boxes are, C flags of which B are true.
    """
    with np.errstate(all="ignore"):
        share = (high - low) / np.where(np.isfinite(width), width, 1.0)[:, None]
        share = np.where(np.isfinite(share), share, 1e30)
        share = share / share.sum(axis=0)
        score = 1e-3 * share
        for form in forms:
            score = score + _variation(form, chosen, share)
    return np.where(np.isfinite(score), score, 0.0).argmax(axis=0)


def _variation(form: Form, open_: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the part of a range that each axis makes, shape (n, B)."""
    slopes, radius = np.abs(form.slopes[:, open_]), form.radius[open_]
    total = slopes.sum(axis=0) + radius
    part = (slopes + share * radius) / total
    return np.where(np.isfinite(part) & (total > 0.0), part, share)


def middle_of(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return midpoints; where an end is infinite, numbers that are far beyond the other one.

    Args:
        low: lower ends.
        high: upper ends.
    """
    with np.errstate(invalid="ignore"):
        middle = 0.5 * low + 0.5 * high
    middle = np.where(np.isneginf(low) & np.isposinf(high), 0.0, middle)
    middle = np.where(
        np.isfinite(low) & np.isposinf(high), np.maximum(2.0 * low, low + 1.0), middle
    )
    return np.where(
        np.isneginf(low) & np.isfinite(high), np.minimum(2.0 * high, high - 1.0), middle
    )
