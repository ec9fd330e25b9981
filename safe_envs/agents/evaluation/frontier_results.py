"""What can be had, and what policies and filters attain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.priced_values import PricedValues

_FURTHER = 50
"""Points of the line of the largest price."""


@dataclass(frozen=True)
class FrontierPoint:
    """Episodes of a policy under a filter, or at a price of a violation.

    Attributes:
        name: to call it by.
        kind: "policy", "filter", "best" or "price".
        episodes: how many.
        violations: episodes with a violation.
        left: how many of these left the workspace without any h <= 0.
        violation_rate: their share.
        violation_low: lower end of its interval.
        violation_high: upper end.
        return_mean: mean return.
        return_low: lower end of its interval.
        return_high: upper end.
        start_values: mean over its starts of the computed return less the price, at each price.
        price: of a violation, for the kind "price".
    """

    name: str
    kind: str
    episodes: int
    violations: int
    left: int
    violation_rate: float
    violation_low: float
    violation_high: float
    return_mean: float
    return_low: float
    return_high: float
    start_values: tuple[float, ...]
    price: float | None = None


@dataclass(frozen=True, eq=False)
class Frontier:
    """What can be had, as computed, and what policies and filters attain.

    Attributes:
        problem: that was looked at.
        values: the computed returns at prices of a violation.
        attained: episodes of the policies that the prices lead to.
        points: episodes of policies and filters.
        left_out: what has no point, with the reason.
        confidence: of all intervals.
    """

    problem: SafetyProblem
    values: PricedValues
    attained: Sequence[FrontierPoint]
    points: Sequence[FrontierPoint]
    left_out: dict[str, str]
    confidence: float

    def cost(self, point: FrontierPoint) -> float:
        """Return by how much the mean return of a point is below the curve of its own starts."""
        lines = np.array(point.start_values) + point.violation_rate * self.values.prices
        return float(lines.min()) - point.return_mean

    @property
    def excess(self) -> float:
        """By how much a point lies above the curve beyond both its intervals; 0 if none does."""
        found = 0.0
        for point in (*self.points, *self.attained):
            lines = np.array(point.start_values) + point.violation_high * self.values.prices
            found = max(found, point.return_low - float(lines.min()))
        return found

    def needed(self, point: FrontierPoint) -> float:
        """Return the least chance of a violation with which the return of a point can be had."""
        values, prices = np.array(point.start_values)[1:], self.values.prices[1:]
        return float(np.clip(((point.return_mean - values) / prices).max(), 0.0, 1.0))

    def curve(self, count: int = 400, bottom: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return chances of a violation and the largest mean return at them, arrays of one shape.

        The corners of the curve are among them. It begins at the least chance that the prices lead
        to; at smaller ones the largest price alone bounds the return.

        Args:
            count: number of points, at least.
            bottom: return from which that last line is wanted too; None for none of it.
        """
        v, prices = self.values.values, self.values.prices
        corners = np.clip((v[:-1] - v[1:]) / np.diff(prices), 0.0, 1.0)
        least = max(self.values.least_violations, 1e-9)
        spread = np.geomspace(least, 1.0, count) if least < 1.0 else np.ones(1)
        chances = np.unique(np.concatenate([corners[corners >= least], spread]))
        if bottom is not None:
            first = max((bottom - v[-1]) / prices[-1], 0.0)
            further = np.linspace(first, least, _FURTHER, endpoint=False)
            chances = np.concatenate([further[further < least], chances])
        return chances, self.values.largest_return(chances)

    def document(self) -> dict[str, Any]:
        """Return all as JSON-able data."""
        values = self.values
        chances, returns = self.curve()
        return {
            "computed": {
                "violations": chances.tolist(),
                "returns": returns.tolist(),
                "prices": values.prices.tolist(),
                "values": values.values.tolist(),
                "coordinates": [str(s) for s in values.given.small.symbols],
                "cells": list(values.safe_grid.counts),
                "leaving": values.settings.leaving,
                "seconds": values.seconds,
            },
            "attained": [asdict(point) for point in self.attained],
            "points": [
                asdict(p) | {"cost": self.cost(p), "needed": self.needed(p)} for p in self.points
            ],
            "excess": self.excess,
            "left_out": self.left_out,
            "confidence": self.confidence,
        }
