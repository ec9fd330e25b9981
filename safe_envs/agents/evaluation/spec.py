"""What an evaluation is asked for: all that determines its result, and how it is run."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import require_monitoring
from safe_envs.agents.evaluation.episodes_file import require_parquet
from safe_envs.agents.evaluation.statistics import require_confidence
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.engine.choice import require_engine
from safe_envs.errors import ConfigurationError, nearest, require_whole, shown
from safe_envs.filters.conditions.base import Condition, parts_of
from safe_envs.filters.conditions.names import AT_STATE, unfiltered_in_sum
from safe_envs.filters.conditions.syntax import learned_parts, require_known
from safe_envs.filters.conditions.text import parse_conditions, require_readable, spec_of
from safe_envs.filters.estimation.names import settings_of
from safe_envs.filters.learning.models.base import LearnedModel
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import filter_layers
from safe_envs.wrappers.external_env import FilterSpec

OBSERVATIONS = ("estimate", "measurement")
"""What policies may see of a measured env."""


def require_estimation(estimator: Any, belief: Any, observe: Any) -> None:
    """Raise ConfigurationError for options that are out of range.

    Args:
        estimator: text of an estimator; None for none.
        belief: probability.
        observe: what policies see.
    """
    if estimator is not None:
        if not isinstance(estimator, str):
            raise ConfigurationError(
                f"estimator = {shown(estimator)}; give kf, ekf or ukf, with settings"
            )
        settings_of(estimator)
    is_number = isinstance(belief, int | float) and not isinstance(belief, bool)
    if not (is_number and 0.0 < belief < 1.0):
        raise ConfigurationError(
            f"belief = {shown(belief)}; give a probability above 0 and below 1"
        )
    if observe not in OBSERVATIONS:
        raise ConfigurationError(f"observe = {shown(observe)}; {nearest(observe, OBSERVATIONS)}")
    if observe != "estimate" and estimator is None:
        raise ConfigurationError(
            f"observe = {shown(observe)} goes with an estimator; give one, like 'ekf', or leave it"
            " out"
        )


def describe_sensor(problem: Any, spec: Any) -> dict[str, Any]:
    """Return the sensor and the estimator of an evaluation as JSON-able data; {} without a sensor.

    Args:
        problem: a `SafetyProblem`.
        spec: an `EvaluationSpec`.
    """
    measured = problem.measurement
    if measured is None:
        return {}
    channels = [
        {**vars(channel), "expression": str(channel.expression)} for channel in measured.channels
    ]
    return {
        "measurement": {"channels": channels, "delay": measured.delay},
        "estimator": spec.estimator,
        **({} if spec.estimator is None else {"belief": spec.belief, "observe": spec.observe}),
    }


UNFILTERED = "none"
"""Name of the row without any filter."""

KNOWLEDGE = ("model", "plant")
"""What filters may know."""

OBJECTIVES = ("nearest", "clf")
"""Objectives of filters."""

_FLAGS = ("trust", "bounds", "best", "closed_loop", "compare_estimates")

Progress = Callable[[float], None]
"""Is called with the number, or the part, of the work that is done."""

Filter = str | Condition | Sequence[Condition]
"""A text, a condition for every barrier, or one condition for each barrier."""


@dataclass(frozen=True)
class EvaluationSpec:
    """All that determines the result of an evaluation.

    Attributes:
        problem: what to simulate, or the id of a registered env; with a `filter_spec` the id of any
            env that Gymnasium knows.
        policy: a name, a place or a path for `make_policy`; or what `as_policy` takes: an object
            with Stable-Baselines3's `predict`, a class of such objects, or a function of a
            batch of observations.
        filters: texts for `parse_conditions`, conditions, or tuples of one condition for each
            barrier, and "none" for the unfiltered env; None for that and the problem's own.
        options: arguments of `gym.make` for an id; those that are None do not count.
        filter_spec: how filters see a third-party env, or FILE.py:NAME of that. There `problem` is
            the model that filters believe, and episodes are simulated one by one.
        learned: models, or files of `safe-envs identify`, to use in place of learning.
        trust: load a policy's .zip, which runs code that it contains.
        episodes: number for each filter.
        seed: whole number from 0.
        knowledge: what the filters know, "model" or "plant"; those that correct the model start
            from it in any case.
        objective: of the filters, "nearest" to the policy's action or "clf": see
            `SafetyFilter.for_problem`.
        confidence: of all intervals, between 0 and 1.
        bounds: look for bounds, which takes a search of the safe set for each filter.
        repeats: number of identifications of what is learned, from the seed and from children of
            it; 1 where nothing is.
        monitoring: where h is checked: "discrete" at control instants, "continuous" between them
            too.
        best: whether to compute how safe any policy can be.
        closed_loop: whether to compute certified tables of the closed loops, which bound from below
            how safe each filter is with this policy.
        estimator: of the state of a measured problem: "kf", "ekf" or "ukf", with settings. Then
            each filter gets several rows; see `safe_envs.agents.evaluation.resolve`.
        belief: probability of the rows with belief conditions.
        observe: what policies see with an estimator, the problem's features at the "estimate", or
            the "measurement".
        compare_estimates: with an estimator, whether a filter that is named gets rows at the true
            state and with its belief too.

    Raises:
        ConfigurationError: A value is out of range, or parts do not go together.
    """

    problem: SafetyProblem | str
    policy: Any = "nominal"
    filters: Sequence[Filter] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    filter_spec: FilterSpec | str | None = None
    learned: Sequence[LearnedModel | Path | str] = ()
    trust: bool = False
    episodes: int = 1000
    seed: int = 0
    knowledge: str = "model"
    objective: str = "nearest"
    confidence: float = 0.95
    bounds: bool = True
    repeats: int = 1
    monitoring: str = "discrete"
    best: bool = False
    closed_loop: bool = False
    estimator: str | None = None
    belief: float = 0.05
    observe: str = "estimate"
    compare_estimates: bool = True

    def __post_init__(self) -> None:
        for name, least in (("episodes", 1), ("seed", 0), ("repeats", 1)):
            require_whole(name, getattr(self, name), least)
        for name, allowed in (("knowledge", KNOWLEDGE), ("objective", OBJECTIVES)):
            value = getattr(self, name)
            if value not in allowed:
                raise ConfigurationError(f"{name} = {shown(value)}; {nearest(value, allowed)}")
        for name in _FLAGS:
            if not isinstance(getattr(self, name), bool | np.bool_):
                raise ConfigurationError(
                    f"{name} = {shown(getattr(self, name))}; give True or False"
                )
        require_confidence(self.confidence)
        require_monitoring(self.monitoring)
        if self.best and self.monitoring == "continuous":
            raise ConfigurationError(
                "best = True with monitoring = 'continuous': the best attainable safety is of"
                " control instants, and not of the time between them; leave one of the two out"
            )
        if self.closed_loop and (self.monitoring == "continuous" or not self.bounds):
            raise ConfigurationError(
                "closed_loop = True: tables of closed loops are bounds, of control instants and not"
                " of the time between them; leave it out, or take monitoring = 'discrete' and"
                " bounds = True"
            )
        require_estimation(self.estimator, self.belief, self.observe)
        if not isinstance(self.options or {}, Mapping):
            raise ConfigurationError(f"options = {shown(self.options)}; give a dictionary")
        filters = listed(self.filters)
        if not (filters is None or isinstance(filters, Iterable)):
            raise ConfigurationError(
                f"filters = {shown(filters)}; give texts such as 'hocbf:alpha=2,8', and conditions"
            )
        filters = None if filters is None else tuple(filters)
        if filters == ():
            raise ConfigurationError("filters holds no filter; leave it out, or name 'none'")
        given = {k: v for k, v in (self.options or {}).items() if v is not None}
        learned = (self.learned,) if isinstance(self.learned, str | Path) else self.learned
        for name, value in (
            ("filters", filters),
            ("options", given),
            ("learned", tuple(learned)),
            ("policy", str(self.policy) if isinstance(self.policy, Path) else self.policy),
            *((name, int(getattr(self, name))) for name in ("episodes", "seed", "repeats")),
            *((name, bool(getattr(self, name))) for name in _FLAGS),
            ("confidence", float(self.confidence)),
        ):
            object.__setattr__(self, name, value)

    def as_dict(self) -> dict[str, Any]:
        """Return the spec as JSON-able data, from which `from_dict` makes one with the same result.

        `trust` is left out: no file may grant itself the right to run code.

        Raises:
            ConfigurationError: A part is an object that has no text, such as a policy.
        """
        found = {name: getattr(self, name) for name in _WRITTEN}
        if self.filters is not None:
            found["filters"] = [filter_text(each) for each in self.filters]
        found["options"] = dict(self.options)
        found["learned"] = [str(m) if isinstance(m, Path) else m for m in self.learned]
        for name, value in found.items():
            try:
                found[name] = json.loads(json.dumps(value, allow_nan=False, default=_plain))
            except (TypeError, ValueError) as error:
                raise ConfigurationError(
                    f"{name} of the evaluation cannot be written as text; give the id of an env,"
                    " FILE.py:NAME, or the path of a file in its place"
                ) from error
        return found

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], trust: bool = False) -> EvaluationSpec:
        """Make a spec from what `as_dict` returned.

        Args:
            data: as `as_dict` returned it.
            trust: load a policy's .zip, which runs code that it contains.

        Raises:
            ConfigurationError: A key is unknown, `problem` is missing, or a value is out of range.
        """
        for key in data:
            if key not in _WRITTEN:
                raise ConfigurationError(
                    f"an evaluation has no {shown(key)}; {nearest(key, _WRITTEN)}"
                )
        if "problem" not in data:
            raise ConfigurationError("an evaluation needs problem, the id of an env")
        return cls(**data, trust=trust)


_MOST_KEPT = 1_000_000
"""Episodes whose results are kept where it is not said whether to: 40 MB."""

_WRITTEN = tuple(each.name for each in fields(EvaluationSpec) if each.name != "trust")
"""Fields that are written as data."""


@dataclass(frozen=True)
class RunSettings:
    """How an evaluation is run, which does not change its result but for rounding.

    Attributes:
        num_envs: episodes that NumPy simulates side by side.
        jobs: processes of NumPy, or threads of the compiled engine; None for one process, or as
            many threads as there are processors.
        record: keep trajectories for pictures.
        progress: called with the part of the work that is done, from 0 to 1.
        engine: "numpy"; "compiled", which compiles each kind of simulation once; or "auto" for
            the compiled one from 5e6 control periods of a filter on, if it can do it. They
            agree to rounding, but for steps within rounding of a threshold.
        keep_episodes: keep the results of each episode in memory, 40 bytes for one; None for that
            where there are at most 1,000,000 of them, under all filters. What they are needed for
            is an error where they are not kept.
        episodes_out: FILE.parquet to which they are written while they are simulated.

    Raises:
        ConfigurationError: A value is out of range, trajectories are asked of several processes,
            or the file cannot be written.
    """

    num_envs: int = 1024
    jobs: int | None = None
    record: bool = False
    progress: Progress | None = None
    engine: str = "auto"
    keep_episodes: bool | None = None
    episodes_out: Path | str | None = None

    def __post_init__(self) -> None:
        require_whole("num_envs", self.num_envs, 1)
        require_engine(self.engine)
        if not isinstance(self.keep_episodes, bool | np.bool_ | None):
            raise ConfigurationError(
                f"keep_episodes = {shown(self.keep_episodes)}; give True, False or None"
            )
        if self.episodes_out is not None:
            object.__setattr__(self, "episodes_out", Path(self.episodes_out))
            require_parquet(Path(self.episodes_out), "episodes_out")
        if self.jobs is None:
            return
        require_whole("jobs", self.jobs, 1)
        if self.jobs > 1 and self.record:
            raise ConfigurationError(
                f"jobs = {self.jobs}: trajectories for pictures are kept in one process; leave jobs"
                " out, or the picture"
            )

    def keeps(self, episodes: int) -> bool:
        """Return whether the results of each of so many episodes are kept."""
        return episodes <= _MOST_KEPT if self.keep_episodes is None else self.keep_episodes


def _plain(value: Any) -> Any:
    """Return NumPy's numbers and arrays as Python's."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError


def is_unfiltered(filter_text: str) -> bool:
    """Return whether the text of a filter is that of none, at the true state or at an estimate."""
    return filter_text.removesuffix(AT_STATE) == UNFILTERED


def listed(filters: Sequence[Filter] | Filter | None) -> Sequence[Filter] | None:
    """Return filters as a sequence, where one may be given in place of several."""
    return (filters,) if isinstance(filters, str | Condition) else filters


def filter_text(given: Filter) -> str:
    """Return the text of a filter, which is a text, a condition, or one for each barrier."""
    return given if isinstance(given, str) else spec_of(conditions_in(given))


def conditions_in(given: Condition | Sequence[Condition]) -> tuple[Condition, ...]:
    """Return the conditions of a filter that is given as objects.

    Raises:
        ConfigurationError: Something in it is no condition.
    """
    found: tuple[Any, ...] = tuple(given) if isinstance(given, Sequence) else (given,)
    strangers = [each for each in found if not isinstance(each, Condition)]
    if strangers or not found:
        wrong = type(strangers[0]).__name__ if strangers else "an empty tuple"
        raise ConfigurationError(
            f"filters hold {wrong}; give texts such as 'hocbf:alpha=2,8', conditions, or tuples"
            " with a condition for each barrier"
        )
    return found


def checked_filter(name: str, problem: SafetyProblem, known: ControlAffineSDE) -> str | None:
    """Return the text of a filter with all parameters; None where it has to be learned first.

    Args:
        name: of the filter, as it was given.
        problem: whose barriers it is for.
        known: the system that it knows.

    Raises:
        ConfigurationError: It names something unknown.
        RelativeDegreeError: A condition does not suit a barrier.
    """
    if name == UNFILTERED:
        return UNFILTERED
    if UNFILTERED in name.split("+"):
        raise unfiltered_in_sum(name)
    require_known(name, UNFILTERED)
    settings = filter_layers.settings_of(name)
    if settings is not None:
        return settings.text
    if learned_parts(name):
        require_readable(name, problem)
        return None
    conditions = parse_conditions(name, problem)
    # What does not suit a barrier is an error before tables are read, which may take long.
    for barrier, condition in parts_of(tuple(zip(problem.barriers, conditions, strict=True)))[1]:
        replace(condition, belief=None, measurement_error=()).constraint(known, barrier)
    return spec_of(conditions)
