"""What an evaluation is of: a world, a policy and filters, read from its arguments."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.identification import Learning
from safe_envs.agents.evaluation.rollout import Env, Progress
from safe_envs.agents.evaluation.targets import world_of
from safe_envs.agents.policies.registry import policy_file
from safe_envs.agents.rare_events.importance_sampling import TiltedNoiseEnv
from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import ConfigurationError, nearest, require_whole, shown
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import (
    CONDITIONS,
    LEARNED,
    Condition,
    FilterSpec,
    SafetyFilterVectorWrapper,
    parse_conditions,
    require_readable,
    spec_of,
)
from safe_envs.wrappers.learning import LearnedModel

BARE = "none"
"""Name of the row without any filter."""


class EvaluationSpec:
    """A world, a policy and filters. See `safe_envs.agents.evaluation.evaluate.evaluate` for the
    arguments and their errors.

    Attributes:
        simulated: what is simulated.
        problem: its problem.
        actor: who acts.
        names: of the filters, each once.
        learning: of what filters rest on.
        filters: the conditions of each filter, in each repeat; there once everything is learned.
    """

    def __init__(
        self,
        problem: SafetyProblem | str,
        policy: Any,
        filters: Sequence[str] | str | None,
        *,
        trust: bool,
        options: Mapping[str, Any] | None,
        seed: int,
        knowledge: str,
        objective: str,
        spec: FilterSpec | str | None,
        learned: Sequence[LearnedModel | Path | str],
        repeats: int,
    ) -> None:
        require_whole("seed", seed, 0)
        for name, value, allowed in (
            ("knowledge", knowledge, ("model", "plant")),
            ("objective", objective, ("nearest", "clf")),
        ):
            if value not in allowed:
                raise ConfigurationError(f"{name} = {shown(value)}; {nearest(value, allowed)}")
        self.simulated = world_of(problem, options, spec)
        self.problem = self.simulated.problem
        self.actor = self.simulated.policy(policy, trust) if isinstance(policy, str) else policy
        asked = [filters] if isinstance(filters, str) else filters
        self.names = list(dict.fromkeys((BARE, self.simulated.filter) if asked is None else asked))
        self._texts = [_checked(name, self.problem) for name in self.names]
        self.learning = Learning(self.problem, self.names, learned, repeats, seed)
        if self.simulated.spec is not None and self.learning.missing():
            raise ConfigurationError(
                "a filter over an env of somebody else takes what was learned from a log:"
                " NAME:file=FILE"
            )
        self._policy, self._spec, self._knowledge, self._objective = (
            policy,
            spec,
            knowledge,
            objective,
        )
        self.filters: dict[str, list[tuple[Condition, ...]]] = {}

    def learn(self, part: Callable[[], Progress | None]) -> None:
        """Learn what is missing, and read the filters.

        Args:
            part: the progress of the next part of the work.
        """
        for method, repeat in self.learning.missing():
            self.learning.learn(method, repeat, part())
        for name in self.names:
            repeats = range(self.learning.repeats(name))
            self.filters[name] = [
                () if name == BARE else self.learning.conditions(name, repeat) for repeat in repeats
            ]

    def env(self, conditions: Sequence[Condition], num_envs: int) -> Env:
        """A batch of envs behind the filter of conditions, after a first step.

        That step compiles what the filter needs: an error shows before a long run, and the timing
        is of steps.
        """
        env = self.simulated.env(conditions, self._knowledge, self._objective, num_envs)
        env.reset(seed=0)
        space: Any = env.action_space
        env.step(np.clip(np.zeros(space.shape, dtype=space.dtype), space.low, space.high))
        return env

    def drifting_env(self, conditions: Sequence[Condition], lengths: np.ndarray) -> Env:
        """A batch of envs of this project's whose noise may drift, behind the filter of conditions;
        see `TiltedNoiseEnv`."""
        env = TiltedNoiseEnv(self.problem, lengths)
        return (
            SafetyFilterVectorWrapper(env, conditions, self._knowledge, self._objective)
            if conditions
            else env
        )

    def config(self) -> dict[str, Any]:
        """All of it as JSON-able data, for filters that were read."""
        spec, simulated = self._spec, self.simulated
        return {
            "title": simulated.title,
            "env_id": simulated.env_id,
            "options": simulated.options,
            "filter_spec": (
                None if spec is None else spec if isinstance(spec, str) else type(spec).__name__
            ),
            "problem": _describe(self.problem),
            "policy": _describe_policy(self._policy),
            "filters": [
                {"name": name, "spec": text or spec_of(self.filters[name][0])}
                for name, text in zip(self.names, self._texts, strict=True)
            ],
            "knowledge": self._knowledge,
            "objective": self._objective,
        }


class Work:
    """Tells the progress of a number of equal parts, one after the other."""

    def __init__(self, progress: Progress | None, parts: int) -> None:
        self._progress, self._parts, self._begun = progress, parts, 0

    def part(self, whole: float = 1.0) -> Progress | None:
        """The next part, told how much of `whole` is done."""
        before, self._begun = self._begun, self._begun + 1
        told = self._progress
        return None if told is None else lambda done: told((before + done / whole) / self._parts)


def _checked(name: str, problem: SafetyProblem) -> str | None:
    """The text of a filter with all its parameters, where it rests on nothing learned; the others
    are read once that is there."""
    if name == BARE:
        return BARE
    if BARE in name.split("+"):
        raise ConfigurationError(
            f"filter {shown(name)}: {BARE!r} is the bare env, no condition of a barrier; give it"
            " alone or leave it out"
        )
    if re.split("[:+]", name)[0] not in (*CONDITIONS, *LEARNED):
        raise ConfigurationError(
            f"unknown filter {shown(name)}; {nearest(name, (BARE, *CONDITIONS, *LEARNED))}"
        )
    if any(re.split(":", part)[0] in LEARNED for part in name.split("+")):
        require_readable(name, problem)
        return None
    return spec_of(parse_conditions(name, problem))


def _describe(problem: SafetyProblem) -> dict[str, Any]:
    return {
        "name": problem.name,
        "plant": {p.name: v for p, v in problem.plant.parameters.items()},
        "model": {p.name: v for p, v in problem.model.parameters.items()},
        "barriers": [str(b.expression) for b in problem.barriers],
        "box": [[float(low), float(high)] for low, high in problem.box],
        "start": problem.start,
        "dt": problem.dt,
        "substeps": problem.substeps,
        "horizon": problem.horizon,
    }


def _describe_policy(policy: Any) -> dict[str, Any]:
    if not isinstance(policy, str):
        return {"name": type(policy).__name__}
    file = policy_file(policy)
    if file is None:
        return {"name": policy}
    return {"name": policy, "sha256": hashlib.sha256(read_bytes(file)).hexdigest()}
