"""First-order forms that note where functions are continuous, kinks or not."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.expression_program import Operation
from safe_envs.dynamics.first_order_forms import Form
from safe_envs.dynamics.form_functions import FormOperations, IntervalMap

_CLOSED = {sp.asin: (-1.0, 1.0), sp.acos: (-1.0, 1.0), sp.acosh: (1.0, math.inf)}
"""Domains of functions that are continuous up to their ends."""


class ContinuousOperations(FormOperations):
    """Operations whose forms are `smooth` where the function is continuous on the closed box.

    A sign of a continuous function changes at a zero only. At a pole or a jump it may change
    without one, and boxes that end there may all be without a zero: 1/x is above 0 on [0, 1] and
    below it on [-1, 0].
    """

    def function(self, kind: Any) -> Operation:
        """Return a function of one argument."""
        applied = super().function(kind)
        if kind not in _CLOSED:
            return applied
        low, high = _CLOSED[kind]

        def continuous(a: Form) -> Form:
            inside = (a.range.low >= low) & (a.range.high <= high)
            return applied(a)._replace(smooth=a.smooth & inside)

        return continuous

    def composed(
        self,
        a: Form,
        value: IntervalMap,
        slope: IntervalMap,
        curve: IntervalMap,
        regular: np.ndarray | None = None,
    ) -> Form:
        """Return a function of a form, which need not be finite on a box without end."""
        smooth = a.smooth if regular is None else a.smooth & regular
        return super().composed(a, value, slope, curve, regular)._replace(smooth=smooth)

    def square_root(self, a: Form) -> Form:
        """Return the root of a."""
        return super().square_root(a)._replace(smooth=a.smooth & (a.range.low >= 0.0))

    def real_power(self, a: Form, exponent: Form) -> Form:
        """Return a^e for a constant e."""
        continuous = a.range.low >= 0.0 if exponent.range.low[0] > 0.0 else a.range.low > 0.0
        return super().real_power(a, exponent)._replace(smooth=a.smooth & continuous)

    def extreme(self, kind: Any) -> Operation:
        """Return the larger or the smaller of two."""
        applied = super().extreme(kind)
        return lambda a, b: applied(a, b)._replace(smooth=a.smooth & b.smooth)

    def _absolute(self, a: Form) -> Form:
        return super()._absolute(a)._replace(smooth=a.smooth)
