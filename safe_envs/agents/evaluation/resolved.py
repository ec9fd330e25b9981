"""From what an evaluation is asked for to what it needs: a target, a policy, filters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.estimation_options import describe_sensor
from safe_envs.agents.evaluation.filter_texts import checked_filter
from safe_envs.agents.evaluation.identification import Learning
from safe_envs.agents.evaluation.spec import (
    UNFILTERED,
    EvaluationSpec,
    Progress,
    conditions_in,
    filter_text,
)
from safe_envs.agents.evaluation.targets import Env, make_target
from safe_envs.agents.jobs.fingerprint import file_checksum
from safe_envs.agents.policies.base import Policy
from safe_envs.agents.policies.custom import policy_name
from safe_envs.agents.policies.names import policy_files
from safe_envs.agents.policies.registry import make_policy
from safe_envs.dynamics.integrators import Integrator
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import (
    Condition,
    SafetyFilterVectorWrapper,
    StateEstimatorVectorWrapper,
    spec_of,
)
from safe_envs.wrappers.conditions.filter_settings import FilterSettings
from safe_envs.wrappers.env_wrappers import lone_filters
from safe_envs.wrappers.estimation import make_estimator
from safe_envs.wrappers.value.closed_loop import require_few_states
from safe_envs.wrappers.value.reduction import reduced

FilterParts = tuple[Condition, ...] | FilterSettings
"""Conditions, none for the unfiltered env, or the settings of a filter that acts by itself."""


class ResolvedEvaluation:
    """A spec with everything made that it names: what is simulated, the policy, the filters.

    Args:
        spec: what is asked for.
        learning: of another evaluation with the same learned filters, to share what it learns.

    Attributes:
        spec: as given.
        target: what is simulated.
        problem: its problem.
        truth: the same without a sensor.
        estimator: of the state, if it is measured and estimated.
        policy: who acts.
        names: of the filters, each once.
        learning: what filters learn.
        filters: what each filter is made of, in each repeat; there once everything is learned.

    Raises:
        ConfigurationError: The spec names something unknown, or parts of it do not fit together.
        RelativeDegreeError: A condition does not suit a barrier.
    """

    def __init__(self, spec: EvaluationSpec, learning: Learning | None = None) -> None:
        self.spec = spec
        self.target = make_target(spec.problem, spec.options, spec.filter_spec)
        self.problem = self.target.problem
        self.truth = self.problem.unmeasured
        self.estimator = (
            make_estimator(spec.estimator, self.problem, spec.knowledge)
            if spec.estimator is not None
            else None
        )
        if self.target.filter_spec is not None:
            _require_third_party(spec)
        seen = self.truth if self.estimator and spec.observe == "estimate" else self.problem
        self.policy = make_policy(
            spec.policy, seen, spec.trust, self.target.spaces, self.target.filter_spec
        )
        asked = (UNFILTERED, self.target.filter) if spec.filters is None else spec.filters
        filters = {filter_text(each): each for each in asked}
        self.names = list(filters)
        self._given = {
            name: self._fitted(conditions_in(each))
            for name, each in filters.items()
            if not isinstance(each, str)
        }
        texts = [name for name in self.names if name not in self._given]
        self._alone = lone_filters.settings_among(texts)
        for settings in self._alone.values():
            settings.require_fit(self.problem, spec.objective)
        self._in_use: list[lone_filters.LoneFilter] = []
        known = self.problem.plant if spec.knowledge == "plant" else self.problem.model
        self._texts = {name: checked_filter(name, self.problem, known) for name in texts}
        self.learning = learning or Learning(
            self.truth, texts, spec.learned, spec.repeats, spec.seed
        )
        if self.target.filter_spec is not None and self.learning.missing():
            raise ConfigurationError(
                "a filter over a third-party env takes what was learned from a log: NAME:file=FILE"
            )
        self.filters: dict[str, list[FilterParts]] = {}
        if spec.best:
            reduced(self.truth, "plant")  # What has no table is known at once.
        if spec.closed_loop:
            require_few_states(self.truth)

    @property
    def prepares(self) -> bool:
        """Whether the policy has long work to do before it acts."""
        return isinstance(self.policy, Policy) and type(self.policy).prepare is not Policy.prepare

    @property
    def parts(self) -> int:
        """Number of parts of the work of `learn`, without the policy's."""
        return len(self.learning.missing()) + len(self._alone)

    def learn(self, part: Callable[[], Progress | None]) -> None:
        """Prepare the policy, learn what is missing, have tables computed, and read the filters.

        Args:
            part: returns the progress of the next part of the work.
        """
        if self.prepares:
            self.policy.prepare(part())
        for method, repeat in self.learning.missing():
            self.learning.learn(method, repeat, part())
        # The envs of the filters find the tables as long as they are in use here.
        self._in_use = [
            lone_filters.lone_filter_for(self.truth, settings, self.spec.knowledge, part())
            for settings in self._alone.values()
        ]
        for name in self.names:
            self.filters[name] = [
                self._conditions(name, repeat) for repeat in range(self.repeats(name))
            ]

    def repeats(self, name: str) -> int:
        """Return how many identifications a filter is evaluated with."""
        return 1 if name in self._given else self.learning.repeats(name)

    def _conditions(self, name: str, repeat: int) -> FilterParts:
        if name == UNFILTERED:
            return ()
        if name in self._alone:
            return self._alone[name]
        return self._given.get(name) or self.learning.conditions(name, repeat)

    def _fitted(self, conditions: tuple[Condition, ...]) -> tuple[Condition, ...]:
        """Return a condition for each barrier, checked against the problem."""
        count = len(self.problem.barriers)
        if len(conditions) not in (1, count):
            allowed = "one" if count == 1 else f"one for all {count} barriers, or one for each"
            raise ConfigurationError(
                f"a filter holds {len(conditions)} conditions; {self.problem.name} takes {allowed}"
            )
        fitted = conditions * count if len(conditions) == 1 else conditions
        for condition in fitted:
            condition.require_fit(self.problem)
        return fitted

    def env(self, conditions: FilterParts, num_envs: int) -> Env:
        """Return a batch of envs behind a filter, after a first step.

        That step compiles what the filter needs: an error shows before a long run, and the timing
        is of steps.

        Args:
            conditions: see `FilterParts`.
            num_envs: size of the batch.
        """
        env = self.filtered(self.target.env(num_envs), conditions)
        env.reset(seed=0)
        space: Any = env.action_space
        env.step(np.clip(np.zeros(space.shape, dtype=space.dtype), space.low, space.high))
        return env

    def filtered(self, env: Any, conditions: FilterParts) -> Env:
        """Return a batch of envs behind a filter, or the env itself without conditions.

        Args:
            env: unfiltered.
            conditions: see `FilterParts`.
        """
        if self.estimator is not None:
            spec = self.spec
            env = StateEstimatorVectorWrapper(env, self.estimator, spec.observe, spec.knowledge)
        if not conditions:
            return env
        return SafetyFilterVectorWrapper(env, conditions, self.spec.knowledge, self.spec.objective)

    @property
    def is_frozen(self) -> bool:
        """Whether nothing is random after the start of an episode."""
        problem, policy = self.problem, self.policy
        noise = Integrator(problem.plant, problem.dt, problem.substeps, "arrays").channels
        exact = self.problem.measurement is None
        return (
            exact and not noise and (policy.deterministic if isinstance(policy, Policy) else True)
        )

    @property
    def is_deterministic(self) -> bool:
        """Whether all episodes are one and the same, as far as is known."""
        random_start = self.problem.starts[self.problem.start].uniforms
        return self.target.filter_spec is None and self.is_frozen and not random_start

    def text_of(self, name: str) -> str:
        """Return the text of a filter with all its parameters, once filters are read."""
        return self._texts.get(name) or _text_of(self.filters[name][0])

    def config(self) -> dict[str, Any]:
        """Return all that determines the result as JSON-able data, once filters are read."""
        spec, target, filter_spec = self.spec, self.target, self.spec.filter_spec
        named = filter_spec is None or isinstance(filter_spec, str)
        return {
            "title": target.title,
            "env_id": target.env_id,
            "options": target.options,
            "filter_spec": filter_spec if named else type(filter_spec).__name__,
            "problem": _describe(self.problem),
            "policy": _describe_policy(spec.policy),
            "filters": [{"name": name, "spec": self.text_of(name)} for name in self.names],
            "knowledge": spec.knowledge,
            "objective": spec.objective,
            "seed": spec.seed,
            "confidence": spec.confidence,
            "monitoring": spec.monitoring,
            **describe_sensor(self.problem, spec),
        }


def conditions_of(parts: FilterParts) -> tuple[Condition, ...]:
    """Return the conditions of a filter; none for the unfiltered env and a filter by itself."""
    return () if isinstance(parts, FilterSettings) else parts


def _text_of(parts: FilterParts) -> str:
    return parts.text if isinstance(parts, FilterSettings) else spec_of(parts)


def _require_third_party(spec: EvaluationSpec) -> None:
    """Raise ConfigurationError for what cannot be had of a third-party env."""
    if spec.monitoring == "continuous":
        raise ConfigurationError(
            "monitoring = 'continuous': the path of a third-party env between its steps is"
            " unknown; use 'discrete'"
        )
    for name in ("best", "closed_loop"):
        if getattr(spec, name):
            raise ConfigurationError(
                f"{name} = True needs the step of the env, not only a model of it; leave it out"
            )
    if spec.knowledge != "model":
        raise ConfigurationError(
            f"knowledge = {shown(spec.knowledge)}: nothing is known but the model of such an env"
        )


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
        **({} if problem.direct else {"actuators": problem.actuators}),
        **({"rate_limit": [list(ends) for ends in problem.rates]} if problem.rates else {}),
    }


def _describe_policy(policy: Any) -> dict[str, Any]:
    if not isinstance(policy, str):
        return {"name": policy_name(policy)}
    found = {"name": policy}
    for key, file in zip(("sha256", "statistics_sha256"), policy_files(policy), strict=False):
        found[key] = file_checksum(file)
    return found
