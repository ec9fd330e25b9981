"""Mean values over the starts of a problem."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from safe_envs.dynamics.codegen import Components, compile_function
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem

_STARTS = {1: 600_000, 50: 50_000}
_FEWEST = 20_000
"""Starts by the number of boxes of noise up to which a look ahead is fast enough for so many."""

_DOUBT = 1e-4
"""Chance that the mean over all starts lies outside the interval of the drawn ones."""

_MOST_ROUNDS = 200


class BoundsStarts(Protocol):
    """What bounds the value at starts.

    Attributes:
        noise_boxes: number of boxes into which the noise of a step is divided.
    """

    noise_boxes: int

    def start_bounds(self, x: Components) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds of the value at states x, arrays of one shape."""
        ...


class StartValues(NamedTuple):
    """Largest probability to stay safe, as a mean over the starts of a problem.

    Attributes:
        lower: a lower bound of it.
        upper: an upper bound of it.
        starts: that were drawn; 1 where all episodes begin in one state.
        margin: by which both bounds are widened, since only some starts were drawn.
    """

    lower: float
    upper: float
    starts: int
    margin: tuple[float, float]


def start_values(
    look_ahead: BoundsStarts, problem: SafetyProblem, seed: int = 0, most: int | None = None
) -> StartValues:
    """Return bounds of the mean value over the starts, by a step of look-ahead from each.

    Where starts are random, the bounds hold with a confidence of 99.99 %, by an empirical Bernstein
    inequality.

    Args:
        look_ahead: of the problem's table.
        problem: the problem.
        seed: of the starts that are drawn.
        most: how many are drawn at most; None for as many as a look ahead is fast enough for.

    Source: A. Maurer, M. Pontil, Empirical Bernstein bounds and sample variance penalization, COLT
        2009, Theorem 4.
    """
    boxes = look_ahead.noise_boxes
    count = next((n for most, n in _STARTS.items() if boxes <= most), _FEWEST)
    x = draw_starts(problem, min(count, most or count), seed)
    lower, upper = look_ahead.start_bounds(x)
    below, above = sampling_margin(lower), sampling_margin(upper)
    return StartValues(
        max(0.0, float(lower.mean()) - below),
        min(1.0, float(upper.mean()) + above),
        len(lower),
        (below, above),
    )


def draw_starts(problem: SafetyProblem, count: int, seed: int) -> Components:
    """Draw start states of a problem.

    Args:
        problem: the problem.
        count: how many; one where all are the same.
        seed: of the draw.

    Returns:
        n components, arrays of one length.

    Raises:
        ConfigurationError: The condition of the starts is hardly ever met.
    """
    start = problem.starts[problem.start]
    count = count if start.uniforms else 1
    state = compile_function(start.uniforms, start.state, "arrays")
    accept = None
    if start.condition is not None:
        condition = (problem.model.numeric(start.condition),)
        accept = BarrierFunction(problem.model.states, condition, "arrays")
    rng, found, missing = np.random.default_rng(seed), [], count
    for _ in range(_MOST_ROUNDS):
        uniforms = rng.random((len(start.uniforms), count))
        x = np.stack([np.broadcast_to(c, count) for c in state(*uniforms)])
        if accept is not None:
            x = x[:, np.broadcast_to(accept(*x)[0] > 0.0, count)]
        found.append(x[:, :missing])
        missing -= found[-1].shape[1]
        if missing == 0:
            return tuple(np.concatenate(found, axis=1))
    raise ConfigurationError(
        f"the starts {problem.start!r} of {problem.name} hardly ever meet their condition"
    )


def sampling_margin(values: np.ndarray) -> float:
    """Return how far the mean of all values may be from that of a sample, at 99.99 % confidence.

    Args:
        values: of the sample, in [0, 1], shape (B,); one value is that of all starts.

    Source: see `start_values`.
    """
    n = len(values)
    if n == 1:
        return 0.0
    doubt = math.log(4.0 / _DOUBT)
    return math.sqrt(2.0 * float(values.var(ddof=1)) * doubt / n) + 7.0 * doubt / (3.0 * (n - 1))
