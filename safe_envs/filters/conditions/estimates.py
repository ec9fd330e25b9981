"""Constraints of conditions that know that the state is an estimate.

Of an estimate x^ with the error's covariance P, the belief barrier is

    h_B = h(x^) - z sqrt(q),    q = grad h' (P + dt/4 sigma sigma') grad h + 1/2 tr(H P H P).

The first term is the variance of h to first order. The second makes the rate of the root finite at
a start that is known, where P = 0; the third, with the Hessian H of h, where grad h = 0, and with
it q is the variance of a quadratic h. Both only enlarge the margin.

**What is proved.** Let the model be linear with Gaussian noise, its estimate that of the Kalman
filter, and h = c' x + d. Given the measurements y_0..y_k, and with inputs that are functions of
these (and of independent random numbers), the state X_k is Gaussian with mean x^_k and covariance
P_k: P(h(X_k) < 0 | y) = Phi(-h(x^_k)/sqrt(c' P_k c)), which is at most Phi(-z) where h_B >= 0. An
exit is at some instant k with h(X_k) < 0, and there h_B < 0, or not. By the union bound over the
instants 0..K,

    P(exit) <= P(h_B < 0 at some instant) + (K + 1) Phi(-z),

and z = -Phi^-1(delta/(K + 1)) makes the last term delta; for several barriers the union is over
them too. Elsewhere, and for an extended Kalman filter, this is a design that is measured.

**The dynamics of the estimate.** From instant to instant x^ moves by the model's step, and jumps by
K nu, with the innovation's covariance S: dx^ = (f + g u) dt + G dW with G G' = K S K'/dt. P
grows by the positive part of (P_(k+1) - P_k)/dt: where it shrinks, h_B rises by itself, and a
condition that only forbids h_B to fall would let h fall instead. Both are known before the sample
for a linear model, and found at the estimate for an extended filter; they are signals of the
system, given at each decision. A condition derives its chain for this system. For a half-space and
Euler's steps the stochastic CBF
then keeps E[h_B at k + 1 | y_0..y_k] >= h_B at k: the mean of x^ moves by dt (f + g u), and the
root is concave and monotone in P, so that its tangent along what P grows is above it.

Source: Clark, Control barrier functions for stochastic systems, Automatica 2021, for barriers of
    the estimate.

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
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.lie import gradient
from safe_envs.dynamics.min_max import clauses
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.enclosures.intervals import interval_function
from safe_envs.errors import ConfigurationError
from safe_envs.filters.conditions.base import AffineConstraint, Condition, require_smooth
from safe_envs.problem.problem import Barrier

_TINY = sp.Float(1e-18)
"""Added to q: without any uncertainty its root has a rate of 0, and not of 0/0."""

Symbols = tuple[sp.Symbol, ...]


@lru_cache(maxsize=64)
def belief_symbols(n: int) -> tuple[Symbols, Symbols, Symbols]:
    """Return the symbols of P, of its rate, and of G, in the order of `BeliefTracker.believed`.

    P and its growth are upper triangles of symmetric matrices, (1, 1), (1, 2), .., (1, n), (2, 2),
    and so on; G is a lower triangle, (1, 1), (2, 1), (2, 2), (3, 1) and so on.

    Args:
        n: number of states.
    """
    upper = [(i, j) for i in range(n) for j in range(i, n)]
    lower = [(i, j) for i in range(n) for j in range(i + 1)]
    groups = (("P", upper), ("P_rate", upper), ("G", lower))
    found = [
        tuple(sp.Symbol(f"belief_{name}_{i + 1}_{j + 1}", real=True) for i, j in places)
        for name, places in groups
    ]
    return found[0], found[1], found[2]


def belief_system(model: ControlAffineSDE, certain: Collection[int] = ()) -> ControlAffineSDE:
    """Return the dynamics of the estimate of a model's state; see above.

    Args:
        model: that the estimator knows.
        certain: places of states without any uncertainty.
    """
    n = model.n
    spread, rates, jump = belief_symbols(n)
    entries = iter(jump)
    diffusion = [[next(entries) if j <= i else 0 for j in range(n)] for i in range(n)]
    for i in certain:
        diffusion[i] = [0] * n
        for row in diffusion:
            row[i] = 0
    moving: dict[Any, Any] = dict(zip(spread, rates, strict=True))
    still = dict.fromkeys((*rates, *jump), 0)
    return replace(
        model,
        # With numbers in place of parameters, long derivatives need not be searched for them.
        drift=model.numeric(model.drift),
        input_matrix=model.numeric(model.input_matrix),
        diffusion=diffusion,
        parameters={},
        signals={**{s: model.numeric(r) for s, r in model.signals.items()}, **moving, **still},
    )


def belief_barrier(
    model: ControlAffineSDE, barrier: Barrier, z: float, dt: float, certain: Collection[int] = ()
) -> Barrier:
    """Return h_B; see above.

    Args:
        model: that the estimator knows.
        barrier: h.
        z: standard deviations of the margin.
        dt: control period in s.
        certain: places of states without any uncertainty.
    """
    n, states = model.n, model.states
    spread = _symmetric(belief_symbols(n)[0], n)
    for i in certain:
        spread[i, :], spread[:, i] = sp.zeros(1, n), sp.zeros(n, 1)
    slopes = sp.Matrix([sp.sympify(e) for e in gradient(model, barrier.expression)])
    noise = sp.Matrix(model.numeric(model.diffusion))
    first = spread + sp.Float(dt, 17) / 4 * noise * noise.T
    curvature = sp.hessian(barrier.expression, states)
    bent = curvature * spread
    q = (slopes.T * first * slopes)[0, 0] + (bent * bent).trace() / 2 + _TINY
    return Barrier(barrier.expression - sp.Float(z, 17) * sp.sqrt(q), barrier.name)


def standard_deviations(delta: float, instants: int) -> float:
    """Return z = -Phi^-1(delta/instants).

    Args:
        delta: probability for all instants together.
        instants: K + 1 control instants, times the barriers.

    Raises:
        ConfigurationError: delta/instants is 1/2 or more, and no margin.
    """
    from scipy import stats

    if not 0.0 < delta / instants < 0.5:
        raise ConfigurationError(
            f"belief = {delta} for {instants} instants; give a probability above 0 and below"
            f" {min(1.0, 0.5 * instants):g}"
        )
    return float(stats.norm.isf(delta / instants))


def _symmetric(components: Symbols, n: int) -> sp.Matrix:
    table, entries = sp.zeros(n, n), iter(components)
    for i in range(n):
        for j in range(i, n):
            table[i, j] = table[j, i] = next(entries)
    return table


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


@dataclass(frozen=True)
class EstimateSettings:
    """What conditions at an estimate need to know besides a model and a barrier.

    Attributes:
        dt: control period in s; None if it is not known.
        instants: K + 1 control instants of an episode, which share the probability `belief`.
        region: box that holds the true and the measured states, for `measurement_error`.
        certain: places of states that the estimator knows without any uncertainty.
    """

    dt: float | None = None
    instants: int | None = None
    region: Region | None = None
    certain: tuple[int, ...] = ()


def constraint_at_estimate(
    condition: Condition,
    model: ControlAffineSDE,
    barrier: Barrier,
    settings: EstimateSettings,
    count: int,
) -> AffineConstraint:
    """Return the constraint of a condition, at the true state or at an estimate as it asks.

    Args:
        condition: of the barrier.
        model: that the filter knows.
        barrier: h.
        settings: see there.
        count: of constraints that share the probability `belief`.

    Raises:
        ConfigurationError: A setting is missing, or the condition is none for estimates.
    """
    if condition.belief is None and not condition.measurement_error:
        return condition.constraint(model, barrier)
    plain = replace(condition, belief=None, measurement_error=())
    if condition.autonomous or condition.is_learned:
        raise ConfigurationError(
            f"{condition.name} was learned or proved at true states: leave belief and"
            " measurement_error out, or take a condition of a model, such as scbf or hocbf"
        )
    if len(clauses(barrier.expression)[0]) > 1:
        raise ConfigurationError(
            f"barrier {barrier.name} = {barrier.expression} is a maximum, which {condition.name}"
            " keeps at true states only; leave belief and measurement_error out, or take a smooth"
            " function below it"
        )
    known = model
    if condition.belief is not None:
        if settings.instants is None or settings.dt is None:
            raise ConfigurationError(
                f"belief = {condition.belief}: it is shared by the control instants of an episode,"
                " whose number and length are not known; give instants=K+1 and dt=..., or make"
                " the filter by SafetyFilter.for_problem"
            )
        z = standard_deviations(condition.belief, settings.instants * count)
        barrier = belief_barrier(model, barrier, z, settings.dt, settings.certain)
        known = belief_system(model, settings.certain)
    found = plain.constraint(known, barrier)
    if condition.measurement_error:
        # The mean value theorem, too, takes slopes of what does not jump.
        require_smooth(known, barrier, [*found.coefficient, found.offset], False, kinks=True)
        found = with_bounded_error(
            found, known, condition.measurement_error, settings.region, condition.name
        )
    return found


def with_belief_signals(
    model: ControlAffineSDE, constraints: Sequence[AffineConstraint]
) -> ControlAffineSDE:
    """Return a model with those symbols of a belief as signals that constraints hold.

    Args:
        model: that the filter knows.
        constraints: of the filter.
    """
    used: set[sp.Basic] = set()
    for c in constraints:
        for part in (*c.coefficient, c.offset, *c.chain, c.demand, c.change, *c.domain):
            used |= set() if part is None else part.free_symbols
    found = [s for group in belief_symbols(model.n) for s in group if s in used]
    if not found:
        return model
    return replace(model, signals={**model.signals, **dict.fromkeys(found, 0)})


def belief_places(symbols: Sequence[sp.Symbol], n: int) -> list[int]:
    """Return which of the values of `BeliefTracker.believed` some symbols stand for.

    Args:
        symbols: that a filter is given at run time; those of no belief are left out.
        n: number of states.
    """
    place = {s: i for i, s in enumerate(s for group in belief_symbols(n) for s in group)}
    return [place[s] for s in symbols if s in place]
