"""Filters in the episodes of envs, some of which remember what an episode was so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from safe_envs.compiled.data import Data
from safe_envs.compiled.program import Source
from safe_envs.dynamics.codegen import Components
from safe_envs.envs.info import Info
from safe_envs.errors import ConfigurationError
from safe_envs.problem.actuators import require_delay, require_direct
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.backup import BackupFilter
from safe_envs.wrappers.conditions import spec_of
from safe_envs.wrappers.conditions.filter_settings import FilterSettings
from safe_envs.wrappers.conditions.spec_text import Conditions
from safe_envs.wrappers.env_wrappers.delay_memory import DelayMemory
from safe_envs.wrappers.env_wrappers.lone_filters import (
    LoneFilter,
    lone_filter_for,
    settings_of,
)
from safe_envs.wrappers.estimation import Estimator
from safe_envs.wrappers.filter_qp import FilterDecision
from safe_envs.wrappers.filter_qp.filter_source import filter_source
from safe_envs.wrappers.safety_filter import SafetyFilter
from safe_envs.wrappers.value.promise_filter import PromiseFilter
from safe_envs.wrappers.value.promise_memory import PromiseMemory

FilterChoice = Conditions | FilterSettings | LoneFilter
"""Conditions or their text; or a filter that acts by itself, its settings or their text."""


class EpisodeFilter(Protocol):
    """A filter of a batch of envs, or of one env, which follows their episodes.

    States and inputs are components: floats of one env, or arrays (num_envs,) of a batch.

    Attributes:
        text: of the filter.
        judges_episodes: whether what it keeps is of whole episodes, so that none can begin late.
    """

    text: str
    judges_episodes: bool

    def begin(self, x: Sequence[Any], envs: np.ndarray | None = None, instants: Any = 0) -> None:
        """Begin episodes.

        Args:
            x: n components of the states of all envs.
            envs: which begin an episode, bool (num_envs,); None for all.
            instants: control periods of each episode that have passed, int or (num_envs,).
        """
        ...

    def resume(self, x: Sequence[Any], envs: np.ndarray, instants: Any) -> None:
        """Go on from states that no decision led to: somebody set them.

        Args:
            x: see `begin`.
            envs: whose states were set.
            instants: see `begin`.
        """
        ...

    def decide_floats(self, x: Sequence[float], u: Sequence[float]) -> FilterDecision:
        """Decide for one env; see `SafetyFilter.decide_floats`."""
        ...

    def decide_arrays(self, x: Components, u: Components) -> FilterDecision:
        """Decide for a batch; see `SafetyFilter.decide_arrays`."""
        ...

    def advance(self, x: Sequence[Any], ended: Any) -> None:
        """Go on to the states that the decided inputs led to.

        Args:
            x: n components of the states, before any of them is replaced by a start.
            ended: the envs whose episode is over, bool (num_envs,).
        """
        ...

    def report(self) -> Info:
        """Return what the filter adds to the info of the states reached, arrays (num_envs,)."""
        ...

    def source(self, data: Data) -> Source:
        """Return the compiled form of the filter, or raise NotCompilableError."""
        ...

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return what the filter remembers, in arrays with the batch in front."""
        ...

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Remember what a snapshot holds."""
        ...


class Memoryless:
    """A filter that decides by state and proposed input alone; see `EpisodeFilter`.

    Args:
        safety_filter: which decides.

    Attributes:
        safety_filter: as given.
        text: of its conditions or settings.
    """

    judges_episodes = False

    def __init__(self, safety_filter: SafetyFilter | BackupFilter) -> None:
        self.safety_filter = safety_filter
        self.text = (
            safety_filter.text
            if isinstance(safety_filter, BackupFilter)
            else spec_of([each for _, each in safety_filter.pairs])
        )
        self.decide_floats = safety_filter.decide_floats
        self.decide_arrays = safety_filter.decide_arrays

    def begin(self, x: Sequence[Any], envs: np.ndarray | None = None, instants: Any = 0) -> None:
        """Do nothing.

        Args:
            x: not used.
            envs: not used.
            instants: not used.
        """

    def resume(self, x: Sequence[Any], envs: np.ndarray, instants: Any) -> None:
        """Do nothing.

        Args:
            x: not used.
            envs: not used.
            instants: not used.
        """

    def advance(self, x: Sequence[Any], ended: Any) -> None:
        """Do nothing.

        Args:
            x: not used.
            ended: not used.
        """

    def report(self) -> Info:
        """Return nothing."""
        return {}

    def source(self, data: Data) -> Source:
        """Return the compiled form of the filter, or raise NotCompilableError."""
        found = self.safety_filter
        return (
            found.source(data) if isinstance(found, BackupFilter) else filter_source(found.qp, data)
        )

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return nothing."""
        return {}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Do nothing."""


def episode_filter(
    problem: SafetyProblem,
    given: FilterChoice,
    knowledge: str,
    objective: str,
    priorities: Sequence[float] | None,
    num_envs: int,
    delay: int | None = None,
    estimator: Estimator | None = None,
) -> Memoryless | DelayMemory | PromiseMemory:
    """Return a filter for the episodes of envs.

    Args:
        problem: of the envs.
        given: see `FilterChoice`.
        knowledge: see `SafetyFilter.for_problem`.
        objective: see there.
        priorities: see there.
        num_envs: size of the batch.
        delay: of the inputs as the filter believes it, in control periods; None for that of the
            problem's plant or model, as `knowledge` says.
        estimator: of the state that the filter is given, if that is an estimate.

    Raises:
        ConfigurationError: What is given is unknown or does not fit the problem.
        RelativeDegreeError: A condition does not suit a barrier.
    """
    if isinstance(given, str):
        given = settings_of(given) or given
    if delay is None:
        delay = problem.delay if knowledge == "plant" else problem.believed_delay
    require_delay("delay", delay)
    if isinstance(given, FilterSettings | PromiseFilter | BackupFilter):
        name = given.name if isinstance(given, FilterSettings) else given.settings.name
        require_direct(replace(problem, model_delay=delay), f"{name} filters")
        if priorities is not None:
            raise ConfigurationError(
                f"priorities are of conditions; the {name} filter keeps all barriers together:"
                " leave them out"
            )
        # A filter by itself is of true states, and acts at an estimate as if that were one.
        problem = problem.unmeasured
        if isinstance(given, FilterSettings):
            given.require_fit(problem, objective)
            given = lone_filter_for(problem, given, knowledge)
        given.settings.require_fit(problem, objective)
        given.require_problem(problem)
        return (
            Memoryless(given) if isinstance(given, BackupFilter) else PromiseMemory(given, num_envs)
        )
    if delay != problem.believed_delay:
        problem = replace(problem, model_delay=delay)  # which conditions may refuse
    found = SafetyFilter.for_problem(
        problem, given, knowledge, objective, priorities, estimator=estimator
    )
    return DelayMemory(found, problem, delay, num_envs) if delay else Memoryless(found)
