"""Collecting one-step data: from a problem's plant, or from any env whose state can be set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.dynamics.codegen import stacked, tabulated
from safe_envs.dynamics.integrators import Integrator
from safe_envs.errors import ConfigurationError, InvalidInputError, NumericalError, require_whole
from safe_envs.filters.learning.checks import (
    Progress,
    Purpose,
    random_stream,
    require_problem,
    require_room,
)
from safe_envs.filters.learning.data import Signature, Transitions, numbers
from safe_envs.problem.problem import SafetyProblem
from safe_envs.text import finite_number

Step = Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]
"""From states (B, n), physical inputs (B, m) held and a generator to the states (B, n) one dt
later."""


def plant_step(problem: SafetyProblem, dt: float | None = None) -> Step:
    """Make the step of a problem's plant.

    Args:
        problem: whose plant and number of substeps are taken.
        dt: length of the step in s; None for the control period.

    Raises:
        ConfigurationError: dt is no positive number.
    """
    integrator = Integrator(problem.plant, period_of(problem, dt), problem.substeps, "arrays")

    def step(x: np.ndarray, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        draws = rng.standard_normal((integrator.channels, len(x)))
        return stacked(
            integrator.step(
                tuple(np.ascontiguousarray(x.T)), tuple(np.ascontiguousarray(u.T)), draws
            ),
            len(x),
        )

    return step


def env_step(
    env: gym.Env[Any, Any],
    set_state: Callable[[gym.Env[Any, Any], np.ndarray], object],
    get_state: Callable[[gym.Env[Any, Any]], Any],
    to_action: Callable[[np.ndarray], Any] | None = None,
) -> Step:
    """Make the step of any scalar env whose state can be set, in a Python loop over the states.

    The env is reset, with a seed drawn from the generator, whenever the step is given another
    generator than before: the env's own randomness is then as reproducible as the generator. One
    step of the env has to last the dt that `collect` is given.

    Args:
        env: to be stepped.
        set_state: puts the env into a state (n,); also after an episode has ended, of which the
            step takes no notice.
        get_state: reads the state (n,) off the env.
        to_action: from a physical input (m,) to an action of the env; None if they are the same.
    """
    known: np.random.Generator | None = None

    def step(x: np.ndarray, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        nonlocal known
        if rng is not known:
            env.reset(seed=int(rng.integers(2**31)))
            known = rng
        successors = []
        for state, held in zip(x, u, strict=True):
            set_state(env, state.copy())
            env.step(held.copy() if to_action is None else to_action(held.copy()))
            # A copy: the env may change the very array in the next step.
            successors.append(np.array(get_state(env), dtype=float))
        return np.array(successors)

    return step


def period_of(problem: SafetyProblem, dt: float | None) -> float:
    """Return the length of a step in s, which by default is the control period.

    Args:
        problem: whose control period is taken.
        dt: length of the step in s; None for the control period.

    Raises:
        ConfigurationError: dt is no positive number.
    """
    period = problem.dt if dt is None else finite_number("dt", dt)
    if not period > 0:
        raise ConfigurationError(f"dt = {period} s; give a positive length of a step")
    return period


def sensor_deviations(problem: SafetyProblem) -> np.ndarray:
    """Return the standard deviation with which each state is measured, (n,); 0 without a sensor.

    Args:
        problem: whose sensor is taken.

    Raises:
        ConfigurationError: The sensor does not measure each state by itself.
    """
    states = problem.plant.states
    if problem.measurement is None:
        return np.zeros(len(states))
    known = {c.expression: c for c in problem.measurement.channels}
    missing = [s.name for s in states if s not in known]
    if missing:
        raise ConfigurationError(
            f"the sensor of {problem.name} does not measure {', '.join(missing)} by itself, so that"
            " a log of it is none of states; measure each state, like"
            f" '{missing[0]}:noise=S', or estimate the states and learn from these"
        )
    return np.array([known[s].noise for s in states])


def measured(
    problem: SafetyProblem, x: np.ndarray, successors: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return states as the sensor of a problem sees them: each start once, and each successor.

    Bias is part of what is seen. Losses and delays are not: a log holds complete samples.

    Args:
        problem: whose sensor is taken.
        x: start states, shape (P, n).
        successors: shape (P, K, n).
        rng: of the noise.

    Returns:
        Both, with errors; the same arrays without a sensor.

    Raises:
        ConfigurationError: See `sensor_deviations`.
    """
    if problem.measurement is None:
        return x, successors
    size = sensor_deviations(problem)
    known = {c.expression: c for c in problem.measurement.channels}
    bias = np.array([known[s].bias for s in problem.plant.states])
    return tuple(  # pyright: ignore[reportReturnType]
        each + bias + size * rng.standard_normal(each.shape) for each in (x, successors)
    )


_AT_ONCE = 1 << 17
"""Transitions that are simulated together: few enough for the cache. The noise that a seed gives
depends on it."""

_TRIES_AT_ONCE = 1024
_TRIES_BEFORE_DESPAIR = 1 << 20
_SMALLEST_SHARE = 1e-4


def draw_states(problem: SafetyProblem, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw states uniformly from the region that is explored, where every barrier is positive.

    Args:
        problem: whose region and barriers are taken.
        count: how many states.
        rng: of the draws.

    Returns:
        States, shape (count, n).

    Raises:
        ConfigurationError: the count is no whole number from 1, or too large for the memory, or the
            barriers leave next to nothing of the region.
    """
    require_whole("count", count, 1)
    require_room(
        float(count) * len(problem.states), f"{count} states of {problem.name}", "their number"
    )
    low, high = np.array(problem.sampling_domain.region).T
    found, accepted, tried = [], 0, 0
    while accepted < count:
        if tried >= _TRIES_BEFORE_DESPAIR and accepted < _SMALLEST_SHARE * tried:
            raise ConfigurationError(
                f"only {accepted} of {tried} states drawn from the region"
                f" {problem.sampling_domain.region} of {problem.name} have positive barriers; give"
                " SamplingDomain(region=...) ranges nearer to the safe set"
            )
        drawn = rng.uniform(low, high, (max(count, _TRIES_AT_ONCE), len(low)))
        found.append(drawn[_explored(problem, drawn)])
        accepted += len(found[-1])
        tried += len(drawn)
    return np.concatenate(found)[:count]


def collect(  # noqa: PLR0913 - the friendly keyword form
    problem: SafetyProblem,
    points: int,
    repetitions: int = 1,
    inputs: Sequence[Any] | None = None,
    steps: int = 1,
    seed: int = 0,
    step: Step | None = None,
    dt: float | None = None,
    progress: Progress | None = None,
) -> Transitions:
    """Collect one-step data where a problem is explored, under each of some inputs.

    Of a problem with a measurement the states are those that its sensor sees.

    With several steps, trajectories are followed. Each goes on with the first successor under one
    of the inputs, chosen at random, and restarts from a fresh state where it leaves the region or a
    barrier is not positive.

    Args:
        problem: of what system; its sampling domain says where and under which inputs.
        points: number of start states.
        repetitions: K, how often each step is repeated.
        inputs: J physical inputs (m,) that are tried; None for those of the sampling domain.
        steps: states of each trajectory.
        seed: of all randomness.
        step: how the system is stepped; None for `plant_step(problem, dt)`.
        dt: length of a step in s; None for the control period.
        progress: called with the part that is done.

    Returns:
        Data of P = steps * points * J rows: the states at the beginning of all trajectories, then
        those after one step, and so on; and for each state its inputs in order.

    Raises:
        ConfigurationError: an argument is not allowed, an input is out of its bounds, the data
            would take more than 2 GB, or no states are found.
        InvalidInputError: the inputs are no numbers, or the step returns an array of the wrong
            shape, or data that `Transitions` refuses.
        NumericalError: a successor is not finite.
    """
    require_problem(problem)
    for name, value in (("points", points), ("repetitions", repetitions), ("steps", steps)):
        require_whole(name, value, 1)
    tried, period = (
        _allowed(problem, problem.sampling_domain.inputs if inputs is None else inputs),
        period_of(problem, dt),
    )
    n, rows = len(problem.states), points * len(tried)
    require_room(
        float(steps) * rows * ((repetitions + 1) * n + len(problem.inputs) + 1),
        f"data of {steps} steps from {points} points under {len(tried)} inputs, {repetitions} times"
        " each,",
        "points, repetitions, inputs or steps",
    )
    # Two generators: the states that are drawn do not depend on how often a step is repeated.
    drawing, noise = random_stream(seed, Purpose.DATA).spawn(2)
    # A given step may be that of any plant.
    signature = Signature.of(problem) if step is None else replace(Signature.of(problem), plant=())
    step = plant_step(problem, period) if step is None else step
    x, successors = np.empty((steps, rows, n)), np.empty((steps, rows, repetitions, n))
    u = np.tile(tried, (points, 1))
    tell = (lambda _: None) if progress is None else progress
    for k in range(steps):
        states = (
            draw_states(problem, points, drawing)
            if k == 0
            else _followed(problem, successors[k - 1, :, 0], points, drawing)
        )
        x[k] = np.repeat(states, len(tried), axis=0)
        _repeat(step, x[k], u, noise, successors[k], lambda part, k=k: tell((k + part) / steps))
    every = steps * rows
    seen = measured(
        problem,
        x.reshape(every, n),
        successors.reshape(every, repetitions, n),
        random_stream(seed, Purpose.SENSOR),
    )
    return Transitions(
        signature,
        seen[0],
        np.tile(u, (steps, 1)),
        seen[1],
        np.full(every, period),
        seed,
    )


def collect_paths(
    problem: SafetyProblem,
    states: Any,
    inputs: Any,
    steps: int,
    dt: float,
    step: Step | None = None,
    seed: int = 0,
) -> np.ndarray:
    """Follow paths, each under one input that is held.

    Args:
        problem: of what system.
        states: in which the paths begin, shape (N, n).
        inputs: physical inputs that are held, shape (N, m).
        steps: number of steps.
        dt: length of a step in s.
        step: how the system is stepped; None for `plant_step(problem, dt)`.
        seed: of all randomness.

    Returns:
        The states at the times 0, dt, ..., steps * dt, shape (N, steps + 1, n).

    Raises:
        ConfigurationError: an argument is not allowed, or an input is out of its bounds.
        InvalidInputError: the states or inputs are no numbers, the states have the wrong shape or
            are not finite, or the step returns an array of the wrong shape.
        NumericalError: a state that is reached is not finite.
    """
    require_problem(problem)
    require_whole("steps", steps, 1)
    held, period = _allowed(problem, inputs), period_of(problem, dt)
    begin = numbers("states", states)
    if begin.shape != (len(held), len(problem.states)) or not np.isfinite(begin).all():
        raise InvalidInputError(
            f"states have the shape {begin.shape}; give ({len(held)}, {len(problem.states)}) finite"
            " numbers, a row for each of the inputs"
        )
    require_room(
        float(begin.size) * (steps + 1),
        f"{len(begin)} paths of {steps} steps",
        "their number or their steps",
    )
    noise = random_stream(seed, Purpose.PATHS)
    step = plant_step(problem, period) if step is None else step
    paths = np.empty((len(begin), steps + 1, begin.shape[1]))
    paths[:, 0] = begin
    for k in range(steps):
        paths[:, k + 1] = _stepped(step, paths[:, k], held, noise)
    return measured(problem, begin, paths, random_stream(seed, Purpose.SENSOR))[1]


def _allowed(problem: SafetyProblem, inputs: Any) -> np.ndarray:
    """Return inputs as an array (J, m); raise ConfigurationError where one is out of bounds."""
    names = ", ".join(i.symbol.name for i in problem.inputs)
    tried = numbers("inputs", inputs)
    if tried.ndim != 2 or tried.shape[-1] != len(problem.inputs) or not len(tried):
        raise ConfigurationError(
            f"inputs = {inputs!r}; give one or more vectors of {len(problem.inputs)} numbers each:"
            f" {names}"
        )
    low, high = np.array(problem.input_bounds).T
    within = ((low <= tried) & (tried <= high)).all(axis=1)
    if not within.all():
        raise ConfigurationError(
            f"the input {tried[within.argmin()]} is outside the bounds {problem.input_bounds} of"
            f" {names}; give inputs within them"
        )
    return tried


def _explored(problem: SafetyProblem, x: np.ndarray) -> np.ndarray:
    """Return whether states (B, n) are in the region with positive barriers, shape (B,)."""
    low, high = np.array(problem.sampling_domain.region).T
    barriers = [problem.plant.numeric(b.expression) for b in problem.barriers]
    with np.errstate(all="ignore"):
        values = tabulated(problem.plant.states, barriers)(x)
    return ((low <= x) & (x <= high)).all(axis=1) & (values > 0).all(axis=1)


def _followed(
    problem: SafetyProblem, successors: np.ndarray, points: int, rng: np.random.Generator
) -> np.ndarray:
    """Return the next states (points, n) of trajectories, from their successors (points * J, n)."""
    reached = successors.reshape(points, -1, successors.shape[-1])
    states = reached[np.arange(points), rng.integers(reached.shape[1], size=points)]
    left = ~_explored(problem, states)
    if left.any():
        states[left] = draw_states(problem, int(left.sum()), rng)
    return states


def _repeat(
    step: Step,
    x: np.ndarray,
    u: np.ndarray,
    rng: np.random.Generator,
    successors: np.ndarray,
    progress: Progress,
) -> None:
    """Fill the successors (rows, K, n) of states (rows, n) under inputs (rows, m), part by part."""
    repetitions = successors.shape[1]
    flat = successors.reshape(-1, x.shape[1])
    for begin in range(0, len(flat), _AT_ONCE):
        end = min(begin + _AT_ONCE, len(flat))
        rows = np.arange(begin, end) // repetitions
        flat[begin:end] = _stepped(step, x[rows], u[rows], rng)
        progress(end / len(flat))


def _stepped(step: Step, x: np.ndarray, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return what a step gives; raise an error where these are no states."""
    with np.errstate(all="ignore"):
        successors = np.asarray(step(x, u, rng), dtype=float)
    if successors.shape != x.shape:
        raise InvalidInputError(
            f"a step from states {x.shape} returned {successors.shape}; it has to return a state"
            " for each of them"
        )
    finite = np.isfinite(successors).all(axis=1)
    if not finite.all():
        bad = int(finite.argmin())
        raise NumericalError(
            f"the step from x = {x[bad]} under u = {u[bad]} led to {successors[bad]}; leave such"
            " states out of SamplingDomain(region=...), or give a smaller dt"
        )
    return successors
