"""What a filter and the env below it share, whether that is one env or a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.envs.episode import Episode, Episodes
from safe_envs.envs.info import Info, filter_info
from safe_envs.envs.reset_options import refuse_time
from safe_envs.errors import ConfigurationError
from safe_envs.independent_copies import IndependentCopies
from safe_envs.number_text import finite_number
from safe_envs.problem.actuators import resting_input
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.env_wrappers.belief_values import belief_values_of
from safe_envs.wrappers.env_wrappers.episode_filter import FilterChoice, episode_filter
from safe_envs.wrappers.env_wrappers.estimator_layer import EstimatorLayer, require_truth_below
from safe_envs.wrappers.env_wrappers.external_env import FilterSpec
from safe_envs.wrappers.env_wrappers.filtered_box import input_bounds
from safe_envs.wrappers.value.promise_memory import PromiseMemory


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
        self._tolerance = [1e-6 * (high - low) for low, high in problem.box]
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


def resting_action(problem: SafetyProblem) -> np.ndarray:
    """Return the input within its bounds nearest to 0, reported before any action."""
    return np.array(resting_input(problem.box))


def rest_info(problem: SafetyProblem) -> Info:
    """Return what a filter reports at reset."""
    return filter_info(
        nominal_action=resting_action(problem),
        safe_action=resting_action(problem),
        intervention=False,
        filter_active=False,
        feasible=True,
        slack=0.0,
        slacks=np.zeros(len(problem.barriers)),
        active_barrier=-1,
        episode_interventions=0,
        episode_infeasible=0,
    )
