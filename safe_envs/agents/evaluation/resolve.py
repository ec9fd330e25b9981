"""From what an evaluation is asked for to what it needs: a target, a policy, filters.

A name with `@state` is a filter at the true state: in the same problem without a sensor, whose
noise is the same. Any other name is of the filter at the estimate.

The proof, in `safe_envs.filters.conditions.estimates`, is of the Kalman filter of a linear model
with
Gaussian noise, which is the plant, of unbiased linear measurements, a start that is known, and
barriers that are half-spaces.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import sympy as sp

from safe_envs.agents.evaluation.identification import Learning
from safe_envs.agents.evaluation.rows import (
    EstimationResults,
    EstimationSummary,
    RowKind,
    summary_of,
)
from safe_envs.agents.evaluation.spec import (
    UNFILTERED,
    EvaluationSpec,
    Filter,
    Progress,
    checked_filter,
    conditions_in,
    describe_sensor,
    filter_text,
)
from safe_envs.agents.jobs.store import file_checksum
from safe_envs.agents.policies.base import Policy
from safe_envs.agents.policies.names import policy_files
from safe_envs.agents.policies.registry import make_policy, policy_name
from safe_envs.dynamics.integrators import Integrator
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError, shown
from safe_envs.filters.conditions.base import Condition
from safe_envs.filters.conditions.names import AT_STATE, PARAMETERS
from safe_envs.filters.conditions.syntax import parts_of
from safe_envs.filters.conditions.text import FilterSettings, spec_of
from safe_envs.filters.estimation.estimator import Estimator
from safe_envs.filters.estimation.kalman import ExtendedKalmanFilter, nonlinearity
from safe_envs.filters.estimation.registry import make_estimator
from safe_envs.problem.options import SENSOR_OPTIONS
from safe_envs.problem.problem import SafetyProblem
from safe_envs.registry import full_id, make_problem, title_of
from safe_envs.values.closed_loop import require_few_states
from safe_envs.values.reduction import reduced
from safe_envs.wrappers import filter_layers
from safe_envs.wrappers.estimator import StateEstimatorVectorWrapper
from safe_envs.wrappers.external_env import FilterSpec
from safe_envs.wrappers.monitor import SafetyMonitorVector
from safe_envs.wrappers.safety_filter import SafetyFilterVectorWrapper

Env = SafeVectorEnv | SafetyMonitorVector | SafetyFilterVectorWrapper
"""A batch of envs."""

_MOST_ENVS = 64
"""Third-party envs are stepped one by one: more of them at once would only take memory."""


class NativeTarget:
    """A problem of this project.

    Args:
        problem: the problem, or the id of a registered env.
        options: arguments of `gym.make` for an id.

    Attributes:
        env_id: full id, None for a problem.
        options: as given.
        filter_spec: None.
        spaces: None, those of the problem's env.
        problem: what is simulated.
        filter: its default one.
        title: what results call it.
        why_no_bound: None; a bound may be looked for.

    Raises:
        ConfigurationError: The id or an option is unknown, or options are given for a problem.
    """

    filter_spec = spaces = why_no_bound = None

    def __init__(self, problem: SafetyProblem | str, options: Mapping[str, Any]) -> None:
        self.env_id = full_id(problem) if isinstance(problem, str) else None
        if self.env_id is None and options:
            raise ConfigurationError(
                "options are the arguments of a registered id; configure the problem itself instead"
            )
        self.options = dict(options)
        self.problem = (
            problem if isinstance(problem, SafetyProblem) else make_problem(problem, **self.options)
        )
        self.filter = self.problem.filter
        self.title = self.problem.name if self.env_id is None else title_of(self.env_id, options)

    def env(self, num_envs: int) -> Env:
        """Return a batch of unfiltered envs."""
        return SafeVectorEnv(self.problem, num_envs)


class ExternalTarget:
    """A registered third-party env, with the model of it that filters believe as its problem.

    Args:
        env_id: its id.
        filter_spec: how a filter sees it.

    Attributes:
        env_id: as given.
        options: none.
        filter_spec: as given.
        spaces: of observations and actions.
        problem: the model as a problem.
        filter: the one that the filter spec names, or else the default one of the model.
        title: the id.
        why_no_bound: that the model may not be the env.

    Raises:
        ConfigurationError: The env is one of this project, has no time limit, or does not fit the
            spec.
        gymnasium.error.Error: There is no such env.
    """

    why_no_bound = "the env is not this project's, and may differ from the model"

    def __init__(self, env_id: str, filter_spec: FilterSpec) -> None:
        self.env_id = self.title = env_id
        self.filter_spec = filter_spec
        self.options: dict[str, Any] = {}
        with gym.make(env_id) as env:
            if isinstance(getattr(env.unwrapped, "problem", None), SafetyProblem):
                raise ConfigurationError(
                    f"{env_id} has barriers of its own; leave the filter spec out"
                )
            steps = env.spec.max_episode_steps if env.spec else None
            if steps is None:
                raise ConfigurationError(
                    f"{env_id} has no time limit, so that its episodes have no length; register it"
                    " with max_episode_steps"
                )
            self.problem = filter_spec.problem(env.unwrapped, env.action_space, env_id, steps)
            self.spaces = env.observation_space, env.action_space
        self.filter = filter_spec.filter or self.problem.filter

    def env(self, num_envs: int) -> Env:
        """Return a batch of unfiltered envs."""
        size = min(num_envs, _MOST_ENVS)
        env = gym.make_vec(self.env_id, num_envs=size, vectorization_mode="sync")
        return SafetyMonitorVector(env, self.filter_spec)


def make_target(
    problem: SafetyProblem | str, options: Mapping[str, Any], filter_spec: FilterSpec | str | None
) -> NativeTarget | ExternalTarget:
    """Return what to simulate; see `EvaluationSpec` for the arguments.

    Raises:
        ConfigurationError: See the classes; or a filter spec comes with a problem or with options.
    """
    if filter_spec is None:
        return NativeTarget(problem, options)
    given = list(options)
    if not isinstance(problem, str) or given:
        wrong = ", ".join(given) or "a SafetyProblem"
        raise ConfigurationError(
            f"a filter spec is for the id of a third-party env, without {wrong}"
        )
    if isinstance(filter_spec, str):
        filter_spec = FilterSpec.load(filter_spec)
    return ExternalTarget(problem, filter_spec)


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
        self._alone = filter_layers.settings_among(texts)
        for settings in self._alone.values():
            settings.require_fit(self.problem, spec.objective)
        self._in_use: list[filter_layers.LoneFilter] = []
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
            filter_layers.lone_filter_for(self.truth, settings, self.spec.knowledge, part())
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
        "input_bounds": [[float(low), float(high)] for low, high in problem.input_bounds],
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


def delta_of(conditions: Sequence[Condition]) -> float | None:
    """Return the probability that belief conditions allow; None where there are none."""
    given = [condition.belief for condition in conditions if condition.belief is not None]
    return max(given) if given and len(given) == len(conditions) else None


def why_belief_not_proved(
    problem: SafetyProblem, estimator: Estimator, monitoring: str = "discrete"
) -> str | None:
    """Return why the bound is measured and not proved; None where it is proved.

    Args:
        problem: that is simulated.
        estimator: of its state.
        monitoring: where violations are looked for; the bound is of the control instants.
    """
    nonlinear = nonlinearity(estimator)
    states = problem.plant.states
    expressions = {b.name: problem.plant.numeric(b.expression) for b in problem.barriers}
    bent = [name for name, h in expressions.items() if not _is_affine(h, states)]
    channels = estimator.measurement.channels
    reasons = {
        f"the estimator is no Kalman filter: {nonlinear}": bool(nonlinear),
        f"{estimator.name} is none of a linear model": not isinstance(
            estimator, ExtendedKalmanFilter
        ),
        "the model is not the plant": any(
            _parts(system) != _parts(problem.plant) for system in (problem.model, estimator.model)
        ),
        "the estimator has noise that the plant has not": any(estimator.added),
        "the start is not known": bool(problem.starts[problem.start].uniforms),
        "the sensor is biased": any(c.bias for c in channels),
        "violations between the control instants count too": monitoring != "discrete",
        "the sensor is periodic": any(c.period for c in channels),
        f"{', '.join(bent)} is no half-space": bool(bent),
    }
    return next((reason for reason, holds in reasons.items() if holds), None)


def _is_affine(h: sp.Expr, states: Sequence[sp.Symbol]) -> bool:
    return all(sp.simplify(e) == 0 for e in sp.hessian(h, list(states)))


def _parts(system: ControlAffineSDE) -> tuple[object, ...]:
    return tuple(
        sp.ImmutableMatrix(system.numeric(part))
        for part in (system.drift, system.input_matrix, system.diffusion)
    )


AT_ESTIMATES = "it decides at an estimate, and these bounds are of filters at the true state"
"""Why filters at an estimate have no bounds of true states."""


class View(NamedTuple):
    """A row of an evaluation.

    Attributes:
        name: of the row.
        base: name of its filter in what is resolved.
        resolved: the evaluation at the true state, or at the estimate.
    """

    name: str
    base: str
    resolved: ResolvedEvaluation

    @property
    def kind(self) -> RowKind:
        """What the row is of."""
        return "unfiltered" if self.base == UNFILTERED else "filter"

    @property
    def estimates(self) -> bool:
        """Whether the filter decides at an estimate."""
        return self.resolved.estimator is not None

    @property
    def filters(self) -> list[FilterParts]:
        """What the filter is made of, in each repeat; there once everything is learned."""
        return self.resolved.filters[self.base]

    @property
    def described(self) -> dict[str, str]:
        """Name and text of the filter."""
        return {"name": self.name, "spec": self.resolved.text_of(self.base)}

    @property
    def why_no_bound(self) -> str | None:
        """Why not to look for bounds that are of true states; None where they are."""
        if self.estimates:
            return AT_ESTIMATES
        conditions = conditions_of(self.filters[0])
        return AT_ESTIMATES if any(c.measurement_error for c in conditions) else None

    def estimation(
        self, found: Sequence[EstimationResults | None], confidence: float
    ) -> EstimationSummary | None:
        """Return how good the estimates were; None at the true state.

        Args:
            found: of the episodes with each identification.
            confidence: of the intervals.
        """
        estimator = self.resolved.estimator
        parts = [each for each in found if each is not None]
        if estimator is None or not parts:
            return None
        delta = delta_of(conditions_of(self.filters[0]))
        monitoring = self.resolved.spec.monitoring
        why_not = (
            why_belief_not_proved(self.resolved.problem, estimator, monitoring) if delta else None
        )
        return summary_of(EstimationResults.joined(parts), confidence, delta, why_not)


def views_of(spec: EvaluationSpec) -> list[View]:
    """Return the rows of an evaluation, everything made that they need.

    Args:
        spec: what is asked for.

    Raises:
        ConfigurationError: The spec names something unknown, or parts of it do not fit together.
        RelativeDegreeError: A condition does not suit a barrier.
    """
    if spec.estimator is None:
        _refuse_true_state(spec.filters or ())
        only = ResolvedEvaluation(spec)
        return [View(name, name, only) for name in only.names]
    asked = _named(spec)
    at_state = {name: each for name, each, truth in asked if truth}
    at_estimate = {name: each for name, each, truth in asked if not truth}
    resolved: dict[bool, ResolvedEvaluation] = {}
    if at_estimate:
        resolved[False] = ResolvedEvaluation(replace(spec, filters=tuple(at_estimate.values())))
    if at_state:
        given = tuple(at_state.values())
        learning = resolved[False].learning if at_estimate else None
        resolved[True] = ResolvedEvaluation(_without_sensor(spec, given), learning)
    return [View(name, filter_text(each), resolved[truth]) for name, each, truth in asked]


def _named(spec: EvaluationSpec) -> list[tuple[str, Filter, bool]]:
    """Return names, filters, and whether they are at the true state, of all rows."""
    asked = spec.filters
    if asked is None:
        target = make_target(spec.problem, spec.options, spec.filter_spec)
        asked = (UNFILTERED, target.filter)
    # Who names one row at the true state names all.
    explicit = not spec.compare_estimates or any(
        isinstance(each, str) and each.endswith(AT_STATE) for each in asked
    )
    found: dict[str, tuple[str, Filter, bool]] = {}
    for each in asked:
        rows = [_stated(each)] if explicit else _expanded(each, spec.belief)
        for row in rows:
            # At the true state nothing is measured that a policy could see.
            if explicit or not row[2] or spec.observe == "estimate":
                found.setdefault(row[0], row)
    return list(found.values())


def _stated(given: Filter) -> tuple[str, Filter, bool]:
    name = filter_text(given)
    if isinstance(given, str) and given.endswith(AT_STATE):
        return name, given.removesuffix(AT_STATE), True
    return name, given, False


def _expanded(given: Filter, belief: float) -> list[tuple[str, Filter, bool]]:
    """Return a filter at the true state, at the estimate, and with the belief if it can have it."""
    name = filter_text(given)
    known = _with_belief(given, belief)
    if known is None and _sets(given, "belief"):
        return [(name, given, False)]
    rows: list[tuple[str, Filter, bool]] = [(name + AT_STATE, given, True), (name, given, False)]
    return rows if known is None else [*rows, (filter_text(known), known, False)]


def _with_belief(given: Filter, belief: float) -> Filter | None:
    """Return a filter whose conditions know the belief; None where they cannot, or do already."""
    if _sets(given, "belief") or _sets(given, "measurement_error"):
        return None
    if isinstance(given, str):
        parts = [] if given == UNFILTERED else parts_of(given)
        if not parts or any(part.name not in PARAMETERS for part in parts):
            return None
        return "+".join(f"{part.text.strip()}:belief={belief:g}" for part in parts)
    conditions = conditions_in(given)
    if any(condition.is_learned or condition.autonomous for condition in conditions):
        return None
    return tuple(replace(condition, belief=belief) for condition in conditions)


def _sets(given: Filter, parameter: str) -> bool:
    """Return whether a filter sets a parameter of its conditions itself."""
    if isinstance(given, str):
        return f":{parameter}=" in given
    return any(getattr(condition, parameter) for condition in conditions_in(given))


def _without_sensor(spec: EvaluationSpec, filters: Sequence[Filter]) -> EvaluationSpec:
    """Return an evaluation of the same at the true state."""
    problem: Any = spec.problem
    if isinstance(problem, SafetyProblem):
        problem = problem.unmeasured
    options = {name: value for name, value in spec.options.items() if name not in SENSOR_OPTIONS}
    return replace(
        spec,
        problem=problem,
        options=options,
        estimator=None,
        observe="estimate",
        filters=tuple(filters),
    )


def _refuse_true_state(filters: Iterable[str | Condition | Sequence[Condition]]) -> None:
    for each in filters:
        if isinstance(each, str) and each.endswith(AT_STATE):
            raise ConfigurationError(
                f"filter {shown(each)}: without an estimator every filter is at the true state;"
                " leave @state out, or give --measurement default and --estimator ekf (in Python:"
                " options={'measurement': 'default'}, estimator='ekf')"
            )
