"""Steps of a system: of a problem's plant, or of any env whose state can be set."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.dynamics.codegen import stacked
from safe_envs.dynamics.integrators import Integrator
from safe_envs.errors import ConfigurationError
from safe_envs.number_text import finite_number
from safe_envs.problem.problem import SafetyProblem

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
