"""What a filter and the env below it share, whether that is one env or a batch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.engine.formulas import Source
from safe_envs.engine.slots import Data
from safe_envs.envs.episode import DelayLine, Episode, Episodes
from safe_envs.envs.info import Info, filter_info
from safe_envs.envs.starts import refuse_time
from safe_envs.errors import ConfigurationError, IndependentCopies, NotCompilableError
from safe_envs.filters.conditions.names import BACKUP, PROMISE
from safe_envs.filters.conditions.syntax import name_by_itself
from safe_envs.filters.conditions.text import Conditions, FilterSettings, spec_of
from safe_envs.filters.decision_source import filter_source
from safe_envs.filters.delayed_filter import Prediction
from safe_envs.filters.estimation.estimator import Estimator
from safe_envs.filters.qp import FilterDecision
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.actuators import require_delay, require_direct, resting_input
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.backup_filter import BackupFilter, BackupSettings
from safe_envs.text import finite_number
from safe_envs.values.promise_filter import (
    PromiseFilter,
    PromiseMemory,
    PromiseSettings,
    promise_filter_for,
)
from safe_envs.wrappers.estimator import EstimatorLayer, belief_values_of, require_truth_below
from safe_envs.wrappers.external_env import FilterSpec
from safe_envs.wrappers.monitor import MonitorLayer

_KEY = "filter_under_way"


class EpisodeFilter:
    """A filter of a batch of envs, or of one env, which follows their episodes.

    This one decides by state and proposed input alone, and remembers nothing. States and inputs are
    components: floats of one env, or arrays (num_envs,) of a batch. `PromiseMemory` has the same
    methods.

    Args:
        safety_filter: which decides.

    Attributes:
        safety_filter: as given.
        text: of its conditions or settings.
        judges_episodes: whether what it keeps is of whole episodes, so that none can begin late.
    """

    judges_episodes = False

    def __init__(self, safety_filter: SafetyFilter | BackupFilter) -> None:
        self.safety_filter = safety_filter
        self.text = (
            safety_filter.text
            if isinstance(safety_filter, BackupFilter)
            else spec_of([each for _, each in safety_filter.pairs])
        )

    def begin(self, x: Sequence[Any], envs: np.ndarray | None = None, instants: Any = 0) -> None:
        """Begin episodes.

        Args:
            x: n components of the states of all envs.
            envs: which begin an episode, bool (num_envs,); None for all.
            instants: control periods of each episode that have passed, int or (num_envs,).
        """

    def resume(self, x: Sequence[Any], envs: np.ndarray, instants: Any) -> None:
        """Go on from states that no decision led to: somebody set them; see `begin`."""

    def decide_floats(self, x: Sequence[float], u: Sequence[float]) -> FilterDecision:
        """Decide for one env; see `SafetyFilter.decide_floats`."""
        return self.safety_filter.decide_floats(x, u)

    def decide_arrays(self, x: Components, u: Components) -> FilterDecision:
        """Decide for a batch; see `SafetyFilter.decide_arrays`."""
        return self.safety_filter.decide_arrays(x, u)

    def advance(self, x: Sequence[Any], ended: Any) -> None:
        """Go on to the states that the decided inputs led to.

        Args:
            x: n components of the states, before any of them is replaced by a start.
            ended: the envs whose episode is over, bool (num_envs,).
        """

    def report(self) -> Info:
        """Return what the filter adds to the info of the states reached, arrays (num_envs,)."""
        return {}

    def source(self, data: Data) -> Source:
        """Return the compiled form of the filter, or raise NotCompilableError."""
        found = self.safety_filter
        return (
            found.source(data) if isinstance(found, BackupFilter) else filter_source(found.qp, data)
        )

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return what the filter remembers, in arrays with the batch in front."""
        return {}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Remember what a snapshot holds."""


class DelayMemory(EpisodeFilter):
    """A filter that decides at the predicted state; see `DelayedFilter`.

    It remembers what it sent itself: the delay that it believes need not be that of the env.

    Args:
        safety_filter: which decides.
        problem: of the envs.
        delay: that is believed, in control periods.
        num_envs: size of the batch.
    """

    def __init__(
        self, safety_filter: SafetyFilter, problem: SafetyProblem, delay: int, num_envs: int
    ) -> None:
        super().__init__(safety_filter)
        self._prediction = Prediction(safety_filter.model, problem.dt, problem.substeps)
        rest = resting_input(problem.input_bounds)
        self._one, self._batch = DelayLine(delay, rest), DelayLine(delay, rest, num_envs)

    def begin(self, x: Sequence[Any], envs: np.ndarray | None = None, instants: Any = 0) -> None:
        """Put resting inputs under way. Where a state is set, what is under way goes on."""
        self._batch.restart(envs)
        if envs is None or len(envs) == 1:
            self._one.restart()

    def decide_floats(self, x: Sequence[float], u: Sequence[float]) -> FilterDecision:
        """Decide for one env, at the predicted state."""
        ahead = self._prediction.of_one(x, self._one.under_way)
        decision = self.safety_filter.decide_floats(ahead, u)
        self._one.exchange(decision.action)
        return decision

    def decide_arrays(self, x: Components, u: Components) -> FilterDecision:
        """Decide for the batch, at the predicted states."""
        ahead = self._prediction.of_batch(x, self._batch.under_way)
        decision = self.safety_filter.decide_arrays(ahead, u)
        self._batch.exchange(decision.action)
        return decision

    def source(self, data: Data) -> Source:
        """Raise NotCompilableError: NumPy decides."""
        raise NotCompilableError(
            f"the filter {self.text} predicts over a delay, which the engine 'numpy' alone can"
        )

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the inputs that are believed to be under way."""
        return {_KEY: self._batch.snapshot()}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Take them from a snapshot."""
        self._batch.restore(snapshot[_KEY])


LoneFilter = PromiseFilter | BackupFilter
"""A filter that acts by itself."""

_READERS: dict[str, Callable[[str], FilterSettings]] = {
    PROMISE: PromiseSettings.of_text,
    BACKUP: BackupSettings.of_text,
}


def settings_of(text: str) -> FilterSettings | None:
    """Return the settings in the text of a filter that acts by itself; None for conditions.

    Args:
        text: of a filter.

    Raises:
        ConfigurationError: The text begins with the name of such a filter, and has another form.
    """
    name = name_by_itself(text)
    return _READERS[name](text) if name else None


def settings_among(texts: Iterable[str]) -> dict[str, FilterSettings]:
    """Return the settings among texts of filters, by these texts; see `settings_of`.

    Args:
        texts: of filters.
    """
    found = {text: settings_of(text) for text in texts}
    return {text: settings for text, settings in found.items() if settings is not None}


def lone_filter_for(
    problem: SafetyProblem,
    settings: FilterSettings,
    knowledge: str = "model",
    progress: Callable[[float], None] | None = None,
) -> LoneFilter:
    """Return the filter of a problem.

    Args:
        problem: that is to be kept safe.
        settings: of the filter.
        knowledge: what it knows, the "model" or the "plant".
        progress: called with the part of a table that is computed, from 0 to 1.

    Raises:
        ConfigurationError: The settings do not fit the problem.
    """
    if isinstance(settings, PromiseSettings):
        return promise_filter_for(problem, settings, knowledge, progress)
    assert isinstance(settings, BackupSettings)
    found = BackupFilter.for_problem(problem, settings, knowledge)
    if progress is not None:
        progress(1.0)
    return found


FilterChoice = Conditions | FilterSettings | LoneFilter
"""Conditions or their text; or a filter that acts by itself, its settings or their text."""


def episode_filter(
    problem: SafetyProblem,
    given: FilterChoice,
    knowledge: str,
    objective: str,
    priorities: Sequence[float] | None,
    num_envs: int,
    delay: int | None = None,
    estimator: Estimator | None = None,
) -> EpisodeFilter | PromiseMemory:
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
        lone = isinstance(given, BackupFilter)
        return EpisodeFilter(given) if lone else PromiseMemory(given, num_envs)
    if delay != problem.believed_delay:
        problem = replace(problem, model_delay=delay)  # which conditions may refuse
    found = SafetyFilter.for_problem(
        problem, given, knowledge, objective, priorities, estimator=estimator
    )
    return DelayMemory(found, problem, delay, num_envs) if delay else EpisodeFilter(found)


_POINTS = 9
"""Actions between the ends of a space at which a map is compared with a straight line."""


def filtered_box(space: Any, inner: Any) -> Any:
    """Return the action space of a filtered env, which knows the physical inputs at its ends.

    It is a Box like the env's own, with a generator of its own, and has these inputs as `at_low`
    and `at_high`, of shape (m,): the former is the larger where the map of actions turns around.
    With them a replay buffer can tell, from the physical `safe_action` of an info alone, which
    action of the space was executed. A class of its own would be needed to load every file into
    which the space is pickled, such as a .zip of Stable-Baselines3.

    Args:
        space: of one env below the filter; where no straight line fits, it is returned as it is.
        inner: layer below the filter that shows the state.

    Raises:
        ConfigurationError: the space is no Box: a wrapper below changed the actions.
    """
    if not isinstance(space, gym.spaces.Box):
        raise ConfigurationError(
            f"the env below the filter takes actions of {space}, and a filter decides on those of a"
            " Box; put wrappers that change actions around the filter"
        )
    if not isinstance(inner, MonitorLayer):
        return _with_ends(space, *input_bounds(space, inner).T)
    part, inputs = _line(space, inner, _POINTS)
    off = np.abs(inputs - ((1.0 - part) * inputs[0] + part * inputs[-1]))
    straight = (off <= 1e-9 * np.abs(inputs[-1] - inputs[0])).all()
    return _with_ends(space, inputs[0], inputs[-1]) if straight else space


def input_bounds(space: Any, inner: Any) -> np.ndarray:
    """Return the physical inputs at the ends of an action space, shape (m, 2).

    Args:
        space: see `filtered_box`.
        inner: see `filtered_box`.
    """
    if isinstance(inner, MonitorLayer):
        return _line(space, inner, 2)[1].T.copy()
    return np.array(inner.problem.input_bounds, dtype=np.float64)


def _line(space: Any, inner: MonitorLayer, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return parts (points, 1) of the way between the ends of a space, and the inputs there."""
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    part = np.linspace(0.0, 1.0, points)[:, None]
    return part, inner.inputs_of((1.0 - part) * low + part * high)


def ends_of(space: gym.Space[Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the inputs at the ends of a space of `filtered_box`; None for other spaces."""
    known = vars(space)
    return (known["at_low"], known["at_high"]) if "at_low" in known else None


def _with_ends(space: gym.spaces.Box, at_low: np.ndarray, at_high: np.ndarray) -> gym.spaces.Box:
    kind: Any = space.dtype
    found: Any = gym.spaces.Box(space.low, space.high, dtype=kind)
    found.at_low, found.at_high = at_low.copy(), at_high.copy()
    return found


class FilterLayer(IndependentCopies):
    """The part of a filter's wrapper that does not depend on the number of envs."""

    _inner: Any

    def attach(
        self,
        inner: Any,
        condition: FilterChoice,
        knowledge: str,
        objective: str,
        priorities: Sequence[float] | None,
        observe_promise: bool,
        delay: int | None,
        num_envs: int = 1,
    ) -> str:
        """Build the filter over the layer of an env that shows its state.

        Args:
            inner: layer that shows the state and takes inputs in physical units.
            condition: see `FilterChoice`.
            knowledge: "model" or "plant".
            objective: "nearest" or "clf".
            priorities: weights of the squared slacks.
            observe_promise: whether observations hold p_k of the promise filter.
            delay: that the filter believes, in control periods; None for the problem's.
            num_envs: size of the batch.

        Returns:
            The text of the filter.

        Raises:
            ConfigurationError: What is given is unknown or does not fit the env.
        """
        problem: SafetyProblem = inner.problem
        require_truth_below(problem, inner)
        estimator = inner.estimator if isinstance(inner, EstimatorLayer) else None
        self._filter = episode_filter(
            problem, condition, knowledge, objective, priorities, num_envs, delay, estimator
        )
        self.safety_filter = self._filter.safety_filter
        self._beliefs = belief_values_of(self.safety_filter, estimator)
        if observe_promise and not isinstance(self._filter, PromiseMemory):
            raise ConfigurationError(
                f"observe_promise = {observe_promise!r}: the filter {self._filter.text} has no p_k"
                " to observe; use promise:p=0.99, or leave it out"
            )
        self._observes = bool(observe_promise)
        text = self._filter.text
        if inner.viewer is not None:
            inner.viewer.caption = text
        self._inner = inner
        # Inputs that pass through an env's numbers are rounded, by float32 at worst.
        self._tolerance = [1e-6 * (high - low) for low, high in problem.input_bounds]
        return text

    def know_bounds(
        self, space: gym.Space[Any], objective: str, batch: tuple[int, ...] = ()
    ) -> None:
        """Have the inputs at the ends of the action space in each info.

        Args:
            space: action space of one env.
            objective: of the filter; one with a goal of its own does not see what is proposed.
            batch: number of envs (B,), for a batch.
        """
        ends = input_bounds(space, self._inner)
        self._bounds = np.tile(ends, (*batch, 1, 1)) if objective == "nearest" else None

    def bounds_info(self) -> Info:
        """Return a new entry for an info: the inputs at the ends of the action space."""
        return {} if self._bounds is None else {"input_bounds": self._bounds.copy()}

    def observation_box(self, space: gym.Space[Any]) -> gym.Space[Any]:
        """Return the space of one env's observations, given that of the env below.

        Raises:
            ConfigurationError: p_k is to be observed, and the observations are no vectors.
        """
        if not self._observes:
            return space
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise ConfigurationError(
                f"observe_promise appends a number to an observation, which is to be a Box of shape"
                f" (k,); {space} is none"
            )
        low, high = np.append(space.low, 0.0), np.append(space.high, 1.0)
        kind: Any = space.dtype
        return gym.spaces.Box(low.astype(kind), high.astype(kind), dtype=kind)

    def observed(self, observation: Any) -> Any:
        """Return the observation of an env or of a batch, with p_k at its end if asked for."""
        if not self._observes:
            return observation
        last = self._filter.report()["promise"].reshape(*np.shape(observation)[:-1], 1)
        return np.concatenate([observation, last], axis=-1, dtype=observation.dtype)

    def require_whole_episodes(self, options: Any) -> None:
        """Raise ConfigurationError where a reset gives a time to episodes that are judged whole.

        Args:
            options: of the reset; those of a third-party env have other meanings.
        """
        if self._filter.judges_episodes and self._inner is self._inner.unwrapped:
            refuse_time(options, f"the filter {self._filter.text}")

    def ask_promise(self, probability: float) -> None:
        """Let the episodes that begin from now on keep a lower probability, and no other ones.

        Args:
            probability: above 0, up to p of the promise filter.

        Raises:
            ConfigurationError: the filter is another one, or the probability out of range.
        """
        memory = self._filter
        if not isinstance(memory, PromiseMemory):
            raise ConfigurationError(
                f"the filter {memory.text} keeps no probability that could be changed; use a"
                " promise filter, like promise:p=0.99"
            )
        most = memory.safety_filter.settings.probability
        if not 0.0 < finite_number("probability", probability) <= most:
            raise ConfigurationError(
                f"probability = {probability!r}; give a number above 0, up to the filter's {most:g}"
            )
        memory.asked = float(probability)

    def known(self, u: Sequence[Any]) -> Sequence[Any]:
        """Return what the filter decides from: components of the state, and of a belief if it has.

        Args:
            u: components of the proposed input.
        """
        x = self._inner.components
        return x if self._beliefs is None else self._beliefs.at(x, self._inner.tracker, u)

    def watch_states(self, episodes: Episode | Episodes) -> None:
        """Look from now on for states that are set.

        Args:
            episodes: counters of the env's episode, or of those of a batch.
        """
        self._episodes, self._placements = episodes, episodes.placements

    def follow(self) -> None:
        """Let the filter know of states that were set since it was last called."""
        if self._episodes.placements is not self._placements:
            changed = np.atleast_1d(self._episodes.placements != self._placements)
            self.watch_states(self._episodes)
            self._filter.resume(self._inner.components, changed, self._episodes.steps)

    def execute(self, env: Any, decided: Sequence[Any], directly: bool) -> Any:
        """Return what the step of an env under the decided input returns.

        Args:
            env: the env below the filter.
            decided: m components of the input.
            directly: whether nothing below can change a step, so that the input need not be
                encoded.

        Returns:
            Observation, reward, terminated, truncated and info.

        Raises:
            ConfigurationError: A wrapper below changed the action, or made another number of steps
                than one.
        """
        if directly:
            return self._inner.step_physical(decided)
        episode = self._episodes
        before = episode.steps
        found = env.step(self._inner.normalized_action(decided))
        if isinstance(episode, Episode) and episode.steps != before + 1:
            raise ConfigurationError(
                f"a wrapper below the filter repeats steps, or starts episodes by itself: {self}."
                " Put it around the filter"
            )
        direct = self._inner.problem.direct
        arrived = self._inner.executed if direct else self._inner.sent
        for u, v, t in zip(decided, arrived, self._tolerance, strict=True):
            if np.count_nonzero(abs(u - v) > t):
                raise ConfigurationError(
                    f"a wrapper below the filter changed the safe action {decided} into"
                    f" {arrived}: {self}. Put wrappers that change actions around the"
                    " filter; several conditions go into one SafetyFilter"
                )
        return found


def third_party_spec(
    env: object, ours: type[Any], view: dict[str, Any], knowledge: str
) -> FilterSpec:
    """Return how a filter sees a third-party env.

    Args:
        env: the env without wrappers.
        ours: class of this project's envs, which need no view.
        view: fields of `FilterSpec`.
        knowledge: what the filter is to know.

    Raises:
        UnknownArgumentError: There is no such field.
        ConfigurationError: The env is this project's, or anything but the model is to be known.
    """
    FilterSpec.refuse_unknown(view)
    if isinstance(env, ours):
        raise ConfigurationError(
            f"{', '.join(view)}: only for third-party envs; {env} has a model and barriers of its"
            " own"
        )
    if knowledge != "model":
        raise ConfigurationError(
            f"knowledge = {knowledge!r}: of a third-party env nothing is known but the model; use"
            " 'model'"
        )
    return FilterSpec.of(view)


def rest_info(problem: SafetyProblem) -> Info:
    """Return what a filter reports at reset."""
    return filter_info(
        nominal_action=np.array(resting_input(problem.input_bounds)),
        safe_action=np.array(resting_input(problem.input_bounds)),
        intervention=False,
        filter_active=False,
        feasible=True,
        slack=0.0,
        slacks=np.zeros(len(problem.barriers)),
        active_barrier=-1,
        episode_interventions=0,
        episode_infeasible=0,
    )
