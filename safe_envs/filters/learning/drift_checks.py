"""Checks of data against a drift that is known, and against the region of a problem."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function, filled, stacked
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, shown
from safe_envs.filters.learning.data import Transitions
from safe_envs.filters.learning.models.network import Network
from safe_envs.problem.problem import SafetyProblem

Estimator = Literal["printed", "centred", "martingale"]
"""Which estimate: see `ito_part`."""

Values = Callable[[Components], Any]
"""A function b at states, from n components (B,) to (B,); a number where it is constant."""

Slopes = Callable[[Components], Components]
"""Its gradient, from n components (B,) to n of them; a number where one is constant."""

_AT_ONCE = 1 << 15
"""Successors that are looked at together, unless a point alone has more: few enough for the cache.
"""

_BULK = 4096
"""States at which a network is evaluated together: few enough for the cache."""

_BLOCK = 64
"""States in a matrix product: few enough for BLAS to stay on one thread, since threads that wait
for each other take far longer."""


@dataclass(frozen=True)
class ItoEstimate:
    """An estimate at each point.

    Attributes:
        values: in the units of b per s, shape (P,).
        deviations: their standard errors, from the spread of the sample, shape (P,); None for a
            single successor a point.
    """

    values: np.ndarray
    deviations: np.ndarray | None


def rates(model: ControlAffineSDE, data: Transitions) -> np.ndarray:
    """Return f(x) + g(x) u of a model at each point.

    Args:
        model: that is known.
        data: transitions under any inputs.

    Returns:
        Rates in units of the states per s, shape (P, n).
    """
    return _rate_of(model, data)(data.x)


def mean_rates(model: ControlAffineSDE, data: Transitions, rate: np.ndarray) -> np.ndarray:
    """Return the mean of f + g u of a model over each step, as the data were integrated.

    An Euler step takes the rate at its beginning, an exact one differs from that by an order of dt,
    and one of several Euler steps is between them. Which it was is one number, found by least
    squares over all data; noise must not be taken for it.

    Args:
        model: that is known.
        data: transitions under any inputs.
        rate: f(x) + g(x) u at each point, shape (P, n); see `rates`.
    """
    dt = data.dt[:, None]
    read = _rate_of(model, data)
    with np.errstate(all="ignore"):
        second = read(data.x + 0.5 * dt * rate)
        third = read(data.x + 0.5 * dt * second)
        curved = (rate + 2.0 * (second + third) + read(data.x + dt * third)) / 6.0 - rate
        curved[~np.isfinite(curved).all(axis=1)] = 0.0
    residual = (data.successors.mean(axis=1) - data.x) / dt - rate
    size = np.mean(residual**2, axis=0)
    weight = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    total = float((weight * curved**2).sum())
    share = float((weight * curved * residual).sum()) / total if total > 0 else 0.0
    return rate + min(max(share, 0.0), 1.0) * curved


def _rate_of(model: ControlAffineSDE, data: Transitions) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function f + g u of a model, of states (P, n) under the inputs of the points."""
    rate = model.numeric(model.drift + model.input_matrix * sp.Matrix(model.inputs))
    compiled, u = (
        compile_function((*model.states, *model.inputs), tuple(rate), "arrays"),
        np.ascontiguousarray(data.u.T),
    )
    return lambda x: stacked(compiled(*np.ascontiguousarray(x.T), *u), len(x))


def by_parts(data: Transitions) -> Iterator[tuple[slice, list[np.ndarray]]]:
    """Yield a few points at a time, with the n components (points, K) of their successors."""
    points = max(1, _AT_ONCE // data.repetitions)
    for begin in range(0, data.points, points):
        part = slice(begin, begin + points)
        yield (
            part,
            [
                np.ascontiguousarray(component)
                for component in np.moveaxis(data.successors[part], 2, 0)
            ],
        )


def in_bulk(network: Network, inputs: Sequence[np.ndarray]) -> np.ndarray:
    """Return the first output of a tanh network at very many states, in fast single precision.

    Args:
        network: with tanh for its activation.
        inputs: its p inputs, components (B,).

    Returns:
        Shape (B,), to about 1e-6 of the output's scale.
    """
    found = np.empty(len(inputs[0]))
    layers = [
        (w.T.astype(np.float32), b.astype(np.float32))
        for w, b in zip(network.weights, network.biases, strict=True)
    ]
    for begin in range(0, len(found), _BULK):
        part = np.stack([component[begin : begin + _BULK] for component in inputs], axis=1)
        z = np.zeros((-(-len(part) // _BLOCK), _BLOCK, len(inputs)), dtype=np.float32)
        z.reshape(-1, len(inputs))[: len(part)] = (part - network.input_mean) / network.input_scale
        for weights, bias in layers[:-1]:
            z = z @ weights
            z += bias
            np.tanh(z, out=z)
        found[begin : begin + _BULK] = (z @ layers[-1][0] + layers[-1][1]).reshape(-1)[: len(part)]
    return found * network.output_scale[0] + network.output_mean[0]


def require_estimator(name: str) -> None:
    """Raise ConfigurationError unless there is an estimator of this name."""
    if name not in get_args(Estimator):
        raise ConfigurationError(
            f"estimator = {shown(name)}; allowed: {', '.join(get_args(Estimator))}"
        )


def ito_part(
    data: Transitions,
    rate: np.ndarray,
    value: Values,
    slopes: Slopes,
    estimator: Estimator = "martingale",
) -> ItoEstimate:
    """Estimate 1/2 tr(sigma sigma' b_xx) at each point, in one of three ways.

    With x_j the K successors of x, and xbar = x + (f + g u) dt:

    - "printed": mean[b(x_j) - b(x)]/dt - grad b(x).(f + g u), whose bias of order dt, 1/2 (f + g
      u)' b_xx (f + g u) dt first of all, is far larger than the signal for the thesis' pendulum,
      and whose standard deviation is |sigma' grad b|/sqrt(K dt).
    - "centred": mean[b(x_j) - b(xbar)]/dt, without that bias, and with the same standard deviation.
    - "martingale": mean[b(x_j) - b(xbar) - grad b(xbar).(x_j - xbar)]/dt, without the martingale
      that makes up that deviation. What is left is sqrt(2/K) of the value itself, for a quadratic b
      and one channel of noise.

    The last two refer to the data's own Euler-Maruyama step: then they are free of bias for a
    quadratic b. For a step that was integrated finer, the printed one's bias comes back in the
    difference between its mean and xbar.

    Args:
        data: transitions under any inputs.
        rate: f(x) + g(x) u at each point, shape (P, n); see `rates`.
        value: b.
        slopes: its gradient.
        estimator: one of the three.

    Raises:
        ConfigurationError: there is no such estimator.

    Source: thesis Eq. (5.17), (5.18), whose sum runs from j = 0 where 1 is meant: one term more
        adds b/(K dt).
    """
    require_estimator(estimator)
    origin = data.x if estimator == "printed" else data.x + rate * data.dt[:, None]
    base = np.ascontiguousarray(origin.T)
    level = filled(value(tuple(base)), (data.points,))
    gradient = stacked(slopes(tuple(base)), data.points)
    values, deviations = np.empty(data.points), np.empty(data.points)
    for part, successors in by_parts(data):
        shape = successors[0].shape
        change = (
            filled(value(tuple(c.reshape(-1) for c in successors)), (successors[0].size,)).reshape(
                shape
            )
            - level[part, None]
        )
        if estimator == "martingale":
            for component, start, slope in zip(successors, base, gradient.T, strict=True):
                change -= (component - start[part, None]) * slope[part, None]
        values[part] = change.mean(axis=1)
        deviations[part] = change.std(axis=1)
    if estimator == "printed":
        values -= (gradient * rate).sum(axis=1) * data.dt
    more = data.repetitions - 1
    return ItoEstimate(values / data.dt, deviations / (data.dt * more**0.5) if more else None)


_SUSPECT = 1.5
"""Score of a drift, in standard errors, from which it does not fit the data."""


_SURE = 5.0
"""Standard errors from which a log does not fit a drift."""


_MATERIAL = 0.05
"""Part of a state's steps, or of all states, from which there is a warning."""


_ROUNDING = 64 * np.finfo(float).eps
"""Part of the size of a state up to which a residual is taken for a rounding error."""


def rounding(data: Transitions, rate: np.ndarray) -> np.ndarray:
    """Return the largest residual of each state that may be a rounding error, shape (n,).

    Args:
        data: transitions.
        rate: f(x) + g(x) u at each point, shape (P, n).
    """
    return _ROUNDING * (np.abs(data.x) + np.abs(rate) * data.dt[:, None]).max(axis=0)


def slack(data: Transitions, rate: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the largest residual of each state that another integration may make, shape (n,).

    Args:
        data: transitions.
        rate: f(x) + g(x) u at each point, shape (P, n).
        mean: its mean over the steps, shape (P, n).
    """
    return _MATERIAL * (np.abs(mean - rate) * data.dt[:, None]).max(axis=0)


def drift_score(data: Transitions, rate: np.ndarray, allowed: np.ndarray | float = 0.0) -> float:
    """Return how far the mean steps are from a drift's, in standard errors; 1 if it is right.

    It is the root mean square over points and states. Steps without repetitions tell nothing and
    score 1, and so do residuals within the rounding.

    Args:
        data: transitions under any inputs.
        rate: f(x) + g(x) u at each point, or its mean over the steps, shape (P, n).
        allowed: part of the mean residual of each state that does not count, shape (n,); see
            `slack`.
    """
    expected, small = (data.x + rate * data.dt[:, None]).T, rounding(data, rate)
    ignored = np.broadcast_to(allowed, small.shape)
    scores = np.ones((data.points, len(expected)))
    for part, successors in by_parts(data):
        for i, after in enumerate(successors):
            residual = after - expected[i, part, None]
            mean = np.maximum(np.abs(residual.mean(axis=1)) - ignored[i], 0.0)
            square = np.einsum("pk,pk->p", residual, residual) / data.repetitions
            np.divide(
                mean**2 * data.repetitions,
                square,
                out=scores[part, i],
                where=square > small[i] ** 2,
            )
    return float(np.sqrt(scores.mean()))


def drift_warnings(
    data: Transitions, rate: np.ndarray, mean: np.ndarray, names: Sequence[str]
) -> tuple[str, ...]:
    """Return warnings where a drift does not fit the data.

    Args:
        data: transitions under any inputs.
        rate: f(x) + g(x) u at each point, shape (P, n).
        mean: what it is over the steps; see `mean_rates`.
        names: of the states.
    """
    score = drift_score(data, mean, slack(data, rate, mean))
    if score >= _SUSPECT:
        return (
            (
                f"the mean steps are {score:.1f} standard errors away from those of the model's f"
                " and g, where 1 is expected: the method takes both for known, and what is learned"
                " of the noise contains their error. A wrong dt looks the same"
            ),
        )
    return _factor_warnings(data, mean, names)


def _factor_warnings(data: Transitions, mean: np.ndarray, names: Sequence[str]) -> tuple[str, ...]:
    """Return warnings for a log without repetitions, by regression on the steps of the drift."""
    moved = mean * data.dt[:, None]
    product = (data.successors.mean(axis=1) - data.x - moved) * moved
    size, total, spread = (
        (moved**2).sum(axis=0),
        product.sum(axis=0),
        np.sqrt((product**2).sum(axis=0)),
    )
    excess = np.divide(total, size, out=np.zeros_like(size), where=size > 0)
    bad = (np.abs(total) > _SURE * spread) & (np.abs(excess) > _MATERIAL)
    if not bad.any():
        return ()
    factors = ", ".join(f"{name} {1.0 + excess[i]:.2g}" for i, name in enumerate(names) if bad[i])
    return (
        (
            "the steps in the data are not those of the model's f and g over dt, but times:"
            f" {factors}. A wrong dt, columns in another order or a wrong model does this; the"
            " method takes all three for right, and what is learned of the noise contains their"
            " error"
        ),
    )


def region_warnings(problem: SafetyProblem, data: Transitions) -> tuple[str, ...]:
    """Return warnings where much of the data is outside the region that is explored.

    Args:
        problem: whose region is taken.
        data: transitions.
    """
    found = []
    for variable, (low, high), column in zip(
        problem.states, problem.sampling_domain.region, data.x.T, strict=True
    ):
        # Of an unbounded angle any turn will do.
        bounded = np.isfinite(variable.low) or np.isfinite(variable.high)
        share = np.mean((column < low) | (column > high))
        if bounded and share > _MATERIAL:
            found.append(
                f"{share:.0%} of the data have {variable.symbol} outside the explored region,"
                f" [{low:g}, {high:g}]: it is from {column.min():g} to {column.max():g}. Learn from"
                " data of the region, where what is learned will be used"
            )
    return tuple(found)
