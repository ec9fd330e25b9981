"""Constraints that are met at every state within a bounded error of the measured one.

With |x_i - x^_i| <= eps_i for all i, on a box R that holds x and x^, by the mean value theorem

    |phi(x) - phi(x^)| <= sum_i sup_R |d phi/d x_i| eps_i =: E(phi)

for phi = b and phi = a_j, so that a(x) u + b(x) >= a(x^) u + b(x^) - E(b) - sum_j E(a_j) |u_j|, and
by Cauchy and Schwarz the last sum is at most |E(a)| |u|. The constraint that is asked for is

    a(x^) u + b(x^) - E(b) >= |E(a)| |u|,

a cone in u, and for one input without loss. The suprema are bounded from above by interval
arithmetic, rounded outwards.

Source: Dean, Taylor, Cosner, Recht, Ames, Guaranteeing safety of learned perception modules via
    measurement-robust control barrier functions, CoRL 2020, whose constants are Lipschitz constants
    of L_f h, L_g h and alpha(h); here they are those of the whole constraint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import sympy as sp

from safe_envs.dynamics.intervals import interval_function
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.conditions.constraint import AffineConstraint

_MOST_BOXES = 4000

Region = Sequence[tuple[float, float]]
"""(low, high) of each state."""


def with_bounded_error(
    constraint: AffineConstraint,
    model: ControlAffineSDE,
    errors: Sequence[float],
    region: Region | None,
    name: str,
) -> AffineConstraint:
    """Return a constraint that is met at every state within the error; see above.

    Args:
        constraint: at the true state.
        model: whose symbols it has.
        errors: eps, one number for all states or one for each.
        region: box that holds the true and the measured states.
        name: of the condition, for errors.

    Raises:
        ConfigurationError: A bound is not finite, or the constraint is not of this form.
    """
    simple = (constraint.demand, constraint.change, constraint.uncertainty, constraint.terms)
    if any(part is not None for part in simple):
        raise ConfigurationError(
            f"measurement_error is not for {name}: its constraint is no a u + b >= 0 of known a and"
            " b, as those of cbf, hocbf, ecbf, scbf and szcbf without a first-order margin are"
        )
    eps = _for_each(errors, model)
    box = _box(model, eps, region)
    of_input = [_error(model, a, eps, box) for a in constraint.coefficient]
    of_offset = _error(model, constraint.offset, eps, box)
    together = math.nextafter(math.hypot(*of_input), math.inf) if any(of_input) else 0.0
    offset = constraint.offset - sp.Float(of_offset, 17)
    if not together:
        return replace(constraint, offset=offset)
    m, square = model.m, sp.Float(math.nextafter(together**2, math.inf), 17)
    entries = [
        square if i == j > 0 else sp.Integer(0) for i in range(m + 1) for j in range(i, m + 1)
    ]
    return replace(constraint, offset=offset, uncertainty=tuple(entries))


def largest_slope(expression: sp.Expr, symbols: Sequence[sp.Symbol], region: Region) -> float:
    """Return an upper bound of the size of an expression on a box, rounded outwards.

    Boxes with the largest bounds are halved, along the longest of their sides that are finite.

    Args:
        expression: of the symbols.
        symbols: the states.
        region: (low, high) of each.

    Returns:
        inf where no bound was found.
    """
    used = [i for i, s in enumerate(symbols) if s in expression.free_symbols]
    function = interval_function([symbols[i] for i in used], [expression])
    if not used:
        (value,) = function([])
        return max(abs(float(value.low)), abs(float(value.high)))
    width = [region[i][1] - region[i][0] for i in used]
    finite = [k for k, w in enumerate(width) if math.isfinite(w) and w > 0.0]
    boxes = np.array([[region[i] for i in used]], dtype=float)
    bound = _sizes(function, boxes)
    while len(boxes) < _MOST_BOXES and finite and not math.isnan(bound.max()):
        chosen = np.argsort(bound)[-max(1, len(boxes) // 2) :]
        rest = np.ones(len(boxes), dtype=bool)
        rest[chosen] = False
        halves = _halved(boxes[chosen], finite, width)
        boxes = np.concatenate([boxes[rest], halves])
        bound = np.concatenate([bound[rest], _sizes(function, halves)])
    return float(np.where(np.isnan(bound), math.inf, bound).max())


def _halved(boxes: np.ndarray, finite: Sequence[int], width: Sequence[float]) -> np.ndarray:
    relative = np.stack([(boxes[:, k, 1] - boxes[:, k, 0]) / width[k] for k in finite], axis=1)
    side = np.array(finite)[relative.argmax(axis=1)]
    rows = np.arange(len(boxes))
    middle = 0.5 * (boxes[rows, side, 0] + boxes[rows, side, 1])
    lower, upper = boxes.copy(), boxes.copy()
    lower[rows, side, 1] = middle
    upper[rows, side, 0] = middle
    return np.concatenate([lower, upper])


def _sizes(function: object, boxes: np.ndarray) -> np.ndarray:
    found = function([(boxes[:, k, 0], boxes[:, k, 1]) for k in range(boxes.shape[1])])[0]  # pyright: ignore[reportCallIssue]
    size = np.maximum(abs(np.asarray(found.low)), abs(np.asarray(found.high)))
    return np.broadcast_to(size, len(boxes)).copy()


def _error(
    model: ControlAffineSDE, expression: sp.Expr, eps: Sequence[float], box: Region
) -> float:
    """Return E(phi), rounded upwards."""
    total = 0.0
    known = model.numeric(expression)
    for state, size in zip(model.states, eps, strict=True):
        slope = sp.diff(known, state)
        if not size or slope == 0:
            continue
        moving = sorted(map(str, slope.free_symbols.difference(model.states)))
        if moving:
            raise ConfigurationError(
                f"measurement_error: how fast the constraint changes with {state} depends on"
                f" {', '.join(moving)}, whose values come in at each call and have no range; take"
                " belief=..., a barrier of which the slopes do not depend on them, or make each a"
                " state"
            )
        bound = largest_slope(slope, model.states, box)
        if not math.isfinite(bound):
            names = [
                s.name
                for s, ends in zip(model.states, box, strict=True)
                if s in slope.free_symbols and not all(map(math.isfinite, ends))
            ]
            raise ConfigurationError(
                f"measurement_error: the constraint changes with {state} without a bound, since"
                f" {', '.join(names) or 'its derivative'} has no finite range or a pole; give"
                " region=[(low, high), ...] for the states"
            )
        total = math.nextafter(total + math.nextafter(bound * size, math.inf), math.inf)
    return total


def _for_each(errors: Sequence[float], model: ControlAffineSDE) -> Sequence[float]:
    if len(errors) not in (1, model.n):
        raise ConfigurationError(
            f"measurement_error has {len(errors)} numbers; give one, or one for each of the"
            f" {model.n} states"
        )
    return tuple(errors) * model.n if len(errors) == 1 else tuple(errors)


def _box(model: ControlAffineSDE, eps: Sequence[float], region: Region | None) -> Region:
    """Return the region with room for the error, which the measured state may be beyond it."""
    if region is None:
        return [(-math.inf, math.inf)] * model.n
    if len(region) != model.n:
        raise ConfigurationError(
            f"region has {len(region)} ranges; give (low, high) for each of the {model.n} states"
        )
    return [(low - e, high + e) for (low, high), e in zip(region, eps, strict=True)]
