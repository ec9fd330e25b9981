"""The promise filter for specifications: what it keeps against a hostile policy, and remembers."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from safe_envs import ConfigurationError, InvalidInputError
from safe_envs.agents.evaluation.promise_bound import PromiseAverager
from safe_envs.agents.evaluation.spec import EvaluationSpec
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.scripts.render import split_filters
from safe_envs.scripts.reports.promise_notes import computed_notes
from safe_envs.wrappers import SafetyFilterVectorWrapper, SpecificationMonitorVector
from safe_envs.wrappers.conditions.text_parts import files_of, with_absolute_paths
from safe_envs.wrappers.value.look_ahead import LookAhead
from safe_envs.wrappers.value.promise_filter import PromiseFilter
from safe_envs.wrappers.value.promise_memory import PromiseMemory
from safe_envs.wrappers.value.promise_tables import promise_filter_for, why_not_of_safety
from safe_envs.wrappers.value.promise_text import PromiseSettings
from safe_envs.wrappers.value.settings import ValueSettings
from safe_envs.wrappers.value.solve import solve

from .walks import NOISE, PERIOD, STEPS, walk

REACH = "always safe & eventually goal"
ORDER = "always safe & eventually (left then right)"
WINDOW = "eventually[3,9] right"
TOUCH = "eventually left"


@functools.cache
def filter_of(text: str, p: float, moves: bool = False) -> PromiseFilter:
    problem = walk(moves=moves, goal=text == REACH)
    settings = ValueSettings(specification=text, cells=(160,), inputs=17)
    look_ahead = LookAhead(solve(problem, settings), problem)
    return PromiseFilter(look_ahead, PromiseSettings(p, specification=text), problem)


def hostile(chosen: PromiseFilter, k: int, x, a) -> np.ndarray:
    """Return the inputs under which the least is expected of the table."""
    ahead = chosen.look_ahead
    q = ahead.scanned(np.full(len(a), k), (*x, a))
    return ahead.inputs[q.argmin(axis=1), 0]


def play(text: str, p: float, moves: bool, episodes: int = 4000):
    """Play episodes under the hostile policy.

    Returns:
        Which met the specification, p_0, p_k of each step, where the filter intervened, verdicts.
    """
    chosen = filter_of(text, p, moves)
    env = SafeVectorEnv(chosen.problem, episodes)
    filtered = SafetyFilterVectorWrapper(env, chosen)
    monitor, memory = SpecificationMonitorVector(filtered, text), filtered._filter
    _, info = monitor.reset(seed=0)
    begun, rows = info["promise"], []
    met, alive = np.zeros(episodes, dtype=bool), np.ones(episodes, dtype=bool)
    for k in range(STEPS):
        np.testing.assert_array_equal(memory._states, info["automaton_state"])
        u, before = hostile(chosen, k, env.components, memory._states), info["verdict"]
        *_, terminated, truncated, info = monitor.step(u[:, None] / 2.0)
        over = (terminated | truncated) & alive
        # Leaving the workspace is a violation, unless all was met before.
        lost = (np.abs(env.components[0]) > 1.0) & (before < 1)
        met[over] = (info["satisfied"] & ~lost)[over]
        assert not info["promise"][over & ~met].any()
        alive &= ~over
        rows.append((info["promise"], info["intervention"], info["feasible"], before, alive | over))
        if not alive.all():  # Episodes of one env only, each once.
            rows[-1] = tuple(np.where(alive | over, part, 0) for part in rows[-1])
    return met, begun, rows
