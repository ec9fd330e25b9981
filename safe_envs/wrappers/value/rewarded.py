"""Problems in few coordinates together with their reward."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function, filled
from safe_envs.errors import ConfigurationError
from safe_envs.problem.frame import Frame
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.value.known_states import known_states, known_values
from safe_envs.wrappers.value.one_step import sub_step
from safe_envs.wrappers.value.reduction import ReducedProblem, reduced

MOST_COORDINATES = 3
"""Axes of a grid of returns."""

_STATES = 4096
_ALIKE = 1e-9
_WIDE = 10.0
"""Range in which states without bounds are drawn."""


@dataclass(frozen=True, eq=False)
class RewardedProblem:
    """A problem in few coordinates, with its reward.

    Attributes:
        small: the problem, with the step of the plant.
        reward: of a step, of the coordinates that it reaches, the inputs, and `TIME`.
    """

    small: ReducedProblem
    reward: sp.Expr

    @property
    def depends_on_time(self) -> bool:
        """Whether the reward does."""
        return TIME in self.reward.free_symbols


def rewarded(problem: SafetyProblem) -> RewardedProblem:
    """Reduce a problem to coordinates that decide what happens and what is rewarded.

    A frame in which the reward is no function of its coordinates is not used.

    Args:
        problem: with the start, noise and bounds in use.

    Raises:
        ConfigurationError: There are too many coordinates, or what happens depends on time.
    """
    frame = problem.frame
    small = reduced(problem, "plant") if frame is not None else None
    reward: Any = problem.plant.numeric(problem.reward)
    if small is not None and frame is not None and not small.note:
        section: Any = dict(zip(problem.plant.states, frame.section, strict=True))
        if _is_invariant(problem, frame, small, reward):
            return _checked(RewardedProblem(small, reward.xreplace(section)))
    small = reduced(replace(problem, frame=None), "plant")
    return _checked(RewardedProblem(small, _with_constants(problem, reward)))


def _checked(found: RewardedProblem) -> RewardedProblem:
    small = found.small
    name, symbols = small.problem.name, small.symbols
    names = ", ".join(map(str, symbols))
    if len(symbols) > MOST_COORDINATES:
        raise ConfigurationError(
            f"the return of {name} takes {len(symbols)} coordinates ({names}); a grid of returns"
            f" takes at most {MOST_COORDINATES}. A declared frame helps only if the reward is a"
            " function of its coordinates"
        )
    moving = found.reward.free_symbols - {*symbols, *small.inputs, TIME}
    if small.known or moving:
        moved = ", ".join(sorted({*map(str, small.known), *map(str, moving)}))
        raise ConfigurationError(
            f"the step, the sets or the reward of {name} change with {moved}, which moves by"
            " itself; returns are computed for problems in which only the reward depends on time"
        )
    return found


def _with_constants(problem: SafetyProblem, reward: Any) -> Any:
    """Return the reward with numbers in place of states that never change."""
    plant = problem.plant
    known = known_states(problem, plant)
    if not known:
        return reward
    _, moved = sub_step(plant, problem.dt / problem.substeps)
    _, constant = known_values(problem, known, dict(zip(plant.states, moved, strict=True)))
    return reward.xreplace(dict(constant))


def _is_invariant(problem: SafetyProblem, frame: Frame, small: ReducedProblem, reward: Any) -> bool:
    """Return whether states with equal coordinates get equal rewards, by a sample."""
    rng = np.random.default_rng(0)
    x = [rng.uniform(max(s.low, -_WIDE), min(s.high, _WIDE), _STATES) for s in problem.states]
    u = [rng.uniform(i.low, i.high, _STATES) for i in problem.inputs]
    t = rng.uniform(0.0, problem.duration, _STATES)
    section = compile_function(small.symbols, frame.section, "arrays")
    alike = section(*small.of_states(tuple(x)))
    function = compile_function((*problem.plant.states, *small.inputs, TIME), (reward,), "arrays")
    values = [
        filled(function(*state, *u, t)[0], (_STATES,))
        for state in (x, [filled(c, (_STATES,)) for c in alike])
    ]
    size = np.abs(values[0]).max()
    return bool(np.allclose(*values, rtol=_ALIKE, atol=_ALIKE * size))
