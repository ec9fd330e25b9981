"""The quadratic program of a filter, as data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.clf import CLF
from safe_envs.wrappers.conditions.constraint import AffineConstraint, Terms


@dataclass(frozen=True)
class FilterQP:
    """Minimise over the input bounds, subject to constraints; see `SafetyFilter`.

    Attributes:
        model: system whose symbols the constraints hold.
        constraints: k constraints.
        low: m lower input bounds.
        high: m upper input bounds.
        weights: m weights of the inputs.
        priorities: k weights of the squared slacks.
        dt: control period in s, 0 where no constraint needs it.
        clf: goal of the joint QP, if there is one.
    """

    model: ControlAffineSDE
    constraints: tuple[AffineConstraint, ...]
    low: list[float]
    high: list[float]
    weights: list[float]
    priorities: list[float]
    dt: float
    clf: CLF | None

    @property
    def plain(self) -> bool:
        """Whether the constraints at the proposed input are all there is.

        Then there is no demand of a reciprocal condition, no sampling margin of first order, no
        goal, and uncertainty only for one input.
        """
        return self.clf is None and all(
            c.demand is None and c.change is None and (c.uncertainty is None or self.model.m == 1)
            for c in self.constraints
        )

    @property
    def terms(self) -> list[Terms]:
        """Learned terms of the constraints, each once."""
        return list(
            {id(c.terms): c.terms for c in self.constraints if c.terms is not None}.values()
        )


def input_bounds(
    model: ControlAffineSDE, box: Sequence[tuple[float, float]]
) -> tuple[list[float], list[float]]:
    """Return the lower and the upper bounds of m inputs.

    Args:
        model: system that has the inputs.
        box: (low, high) of each input, as users give them.

    Raises:
        ConfigurationError: Their number is wrong, or one is not a finite interval.
    """
    if len(box) != model.m:
        raise ConfigurationError(f"box has {len(box)} intervals; the model has {model.m} inputs")
    low, high = [float(pair[0]) for pair in box], [float(pair[1]) for pair in box]
    for symbol, lo, hi in zip(model.inputs, low, high, strict=True):
        if not (math.isfinite(lo) and math.isfinite(hi) and lo < hi):
            raise ConfigurationError(
                f"box of {symbol} is [{lo}, {hi}]; it needs finite bounds, the lower one below the"
                " upper"
            )
    return low, high


def positive_weights(name: str, given: Sequence[float] | None, count: int) -> list[float]:
    """Return weights as floats.

    Args:
        name: of the argument, for errors.
        given: as users give them; None for ones.
        count: how many there are to be.

    Raises:
        ConfigurationError: Their number is wrong, or one is not positive and finite.
    """
    values = [1.0] * count if given is None else [float(v) for v in given]
    if len(values) != count or not all(math.isfinite(v) and v > 0 for v in values):
        raise ConfigurationError(f"{name} = {values}; give {count} positive numbers")
    return values


def control_period(constraints: Sequence[AffineConstraint], dt: float | None) -> float:
    """Return the control period in s, 0 where none is given.

    Args:
        constraints: those of the filter, some of which may need it.
        dt: as users give it.

    Raises:
        ConfigurationError: It is not positive and finite, or missing.
    """
    if dt is None:
        if any(constraint.change is not None for constraint in constraints):
            raise ConfigurationError(
                "a sampling margin of first order needs the control period: SafetyFilter(...,"
                " dt=...)"
            )
        return 0.0
    if not 0 < dt < math.inf:
        raise ConfigurationError(f"dt = {dt} s; a control period is positive and finite")
    return float(dt)
