"""Who simulates the paths of an estimation: NumPy, or a compiled program."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from safe_envs.agents.evaluation.decision_source import decider_of
from safe_envs.agents.evaluation.resolved import FilterParts, ResolvedEvaluation
from safe_envs.agents.evaluation.targets import Env
from safe_envs.agents.jobs.threads import available_threads
from safe_envs.agents.rare_events.compiled_paths import CompiledPaths, PathProgram
from safe_envs.agents.rare_events.numpy_paths import NumpyPaths
from safe_envs.agents.rare_events.particles import PathPlayer
from safe_envs.agents.rare_events.tilted_env import TiltedNoiseEnv
from safe_envs.compiled.engine import compiled_or_none
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.conditions.filter_settings import FilterSettings


class ChosenPlayer(NamedTuple):
    """Who simulates, and how.

    Attributes:
        player: who simulates.
        engine: "numpy" or "compiled".
        jobs: threads.
    """

    player: PathPlayer
    engine: str
    jobs: int


def player_of(
    resolved: ResolvedEvaluation,
    conditions: FilterParts,
    num_envs: int,
    engine: str,
    periods: float,
) -> ChosenPlayer:
    """Return who simulates paths under a filter.

    Args:
        resolved: what to simulate.
        conditions: of the filter, see `FilterParts`.
        num_envs: the most envs of NumPy side by side.
        engine: one of `safe_envs.compiled.engine.ENGINES`.
        periods: control periods to simulate, about.

    Raises:
        ConfigurationError: The filter remembers the path, or the compiled engine was asked for,
            and Numba is missing.
        NotCompilableError: It was asked for, and cannot do this.
    """
    if isinstance(conditions, FilterSettings) and conditions.of_paths:
        raise ConfigurationError(
            f"the filter {conditions.text} remembers {conditions.of_paths}, and paths that are"
            " split go on from states alone; evaluate it with more episodes instead"
        )
    continuous = resolved.spec.monitoring == "continuous"
    reference = NumpyPaths(
        resolved.problem,
        partial(_tilted_env, resolved, conditions),
        resolved.policy,
        num_envs,
        continuous,
    )
    compiled = compiled_or_none(
        engine, periods, partial(_compiled, resolved, conditions, continuous, reference)
    )
    return compiled or ChosenPlayer(reference, "numpy", 1)


def _tilted_env(resolved: ResolvedEvaluation, conditions: FilterParts, lengths: np.ndarray) -> Env:
    return resolved.filtered(TiltedNoiseEnv(resolved.problem, lengths), conditions)


def _compiled(
    resolved: ResolvedEvaluation,
    conditions: FilterParts,
    continuous: bool,
    reference: PathPlayer,
) -> ChosenPlayer:
    decider = decider_of(resolved, conditions)
    program = PathProgram(resolved.problem, resolved.policy, decider, continuous)
    threads = available_threads()
    functions = program.compiled()
    player = CompiledPaths(program, functions, reference, threads)
    return ChosenPlayer(player, "compiled", threads)
