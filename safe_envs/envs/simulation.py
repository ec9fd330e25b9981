"""The one implementation of physics, reward and observation, over floats or arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, Flavour, compile_function
from safe_envs.dynamics.defined import NO_VALUE, careful_floats, defined, defined_arrays
from safe_envs.dynamics.integrators import Integrator
from safe_envs.errors import NumericalError, require_whole
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.problem.starts import StartSampler

LARGEST = 3e38
"""Below it single precision has all numbers."""


class Simulation:
    """The compiled formulas of a problem, without a state: one object serves any number of envs."""

    def __init__(self, problem: SafetyProblem, flavour: Flavour) -> None:
        self.problem = problem
        self.integrator = Integrator(problem.plant, problem.dt, problem.substeps, flavour)
        self._features = len(problem.features)
        self._barriers = self._features + len(problem.barriers)
        read = readings(problem)
        self.timed = TIME in set().union(*(sp.sympify(e).free_symbols for e in read))
        self._read = (*problem.plant.states, *problem.plant.inputs, TIME), tuple(read)
        self._measure = compile_function(*self._read, flavour)
        self._floats = flavour == "floats"
        self.starts = start_sampler(problem)

    def measure(
        self, x: Components, u: Sequence[Any], time: Any
    ) -> tuple[Components, Components, Any, Any, Any]:
        """Return what can be read off a state; arrays warn where a formula has no value.

        Args:
            x: components of the state.
            u: components of the executed input that led to it.
            time: since the start of the episode, in s.

        Returns:
            The features, the barriers (-inf where one has no value), the reward, the distance by
            which the workspace was left (> 0 outside), and the goal (>= 0 where it is reached).
        """
        f, b = self._features, self._barriers
        if not self._floats:
            values = self._measure(*x, *u, time)
            return values[:f], defined_arrays(values[f:b]), *values[b:]
        try:
            values: Any = self._measure(*x, *u, time)
        except NO_VALUE:
            values = careful_floats(*self._read, (*x, *u, time))
        return values[:f], defined(values[f:b]), *values[b:]


def start_sampler(problem: SafetyProblem, start: str | None = None) -> StartSampler:
    """Return what draws the start states of a problem.

    Args:
        problem: with the distributions.
        start: name of one; None for the one in use.
    """
    name = problem.start if start is None else start
    return StartSampler(problem.starts[name], problem.model, f"{problem.name!r} ({name})")


def readings(problem: SafetyProblem) -> tuple[Any, ...]:
    """Return what is read off a state, as expressions of states, inputs and `TIME`.

    These are the features, the barriers, the reward, the distance by which the workspace was left,
    and the goal, which is negative where there is none.
    """
    return (
        *(f.expression for f in problem.features),
        *(b.expression for b in problem.barriers),
        problem.reward,
        problem.outside,
        -1 if problem.goal is None else problem.goal,
    )


def steps_until(problem: SafetyProblem, max_episode_steps: int | None) -> int:
    """Return the control periods until an episode is truncated.

    Args:
        problem: whose horizon is the limit.
        max_episode_steps: a lower limit, if any; -1 is none, as for Gymnasium.

    Raises:
        ConfigurationError: the limit is no whole number from 1.
    """
    if max_episode_steps is None or max_episode_steps == -1:
        return problem.steps
    require_whole("max_episode_steps", max_episode_steps, 1)
    return min(problem.steps, max_episode_steps)


def require_sound(
    x: Components, observation: np.ndarray, reward: np.ndarray, problem: SafetyProblem
) -> None:
    """Check that the states of a batch, their observations and rewards are finite.

    States are numbers of single precision, as observations are.

    Args:
        x: components of the states.
        observation: of each.
        reward: of each.
        problem: that is simulated.

    Raises:
        NumericalError: Some are not.
    """
    seen, there = np.isfinite(observation), (np.abs(x) < LARGEST).all(axis=0)
    sound = there & seen.all(axis=1) & np.isfinite(reward)
    if sound.all():
        return
    if there.all():
        worst = int(np.flatnonzero(~sound)[0])
        state = [float(component[worst]) for component in x]
        i = int(seen[worst].argmin())
        what = "reward" if seen[worst, i] else f"observation {problem.features[i].name}"
        at = ", ".join(f"{s} = {v:.6g}" for s, v in zip(problem.plant.states, state, strict=True))
        raise NumericalError(
            f"the {what} of {problem.name!r} has no finite value at {at}; check it there"
        )
    raise NumericalError(
        f"the states of envs {np.flatnonzero(~there)[:5].tolist()} of {problem.name!r}"
        " have left the finite numbers; reduce dt or raise substeps"
    )
