"""A state estimator over a measured scalar env."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from safe_envs.dynamics.codegen import Components, Flavour, compile_function, stacked
from safe_envs.envs.env import SafeEnv
from safe_envs.envs.episode import Episode, Episodes
from safe_envs.envs.info import Info, VectorStep, with_masks
from safe_envs.envs.sensor import merged
from safe_envs.envs.spaces import observation_box
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError, IndependentCopies, nearest, shown
from safe_envs.filters.conditions.estimates import belief_symbols
from safe_envs.filters.estimation.consistency import nees
from safe_envs.filters.estimation.estimator import Estimator, unpacked
from safe_envs.filters.estimation.registry import make_estimator
from safe_envs.filters.estimation.tracker import BeliefTracker
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.layers import only_checks_between, state_layer

OBSERVATIONS = ("estimate", "measurement")
"""What a policy may see of a measured env."""


class EstimatorLayer(IndependentCopies):
    """The part of an estimator's wrapper that does not depend on the number of envs.

    Attributes:
        problem: of the env.
        viewer: what is drawn of the env, and its caption.
        tracker: the belief.
        estimator: of it.
    """

    tracker: BeliefTracker

    def attach(
        self,
        inner: Any,
        estimator: Estimator | str,
        observe: str,
        knowledge: str,
        num_envs: int | None = None,
    ) -> None:
        """Prepare to follow the samples of an env.

        Args:
            inner: env that is measured.
            estimator: or its text.
            observe: "estimate" or "measurement".
            knowledge: "model" or "plant".
            num_envs: size of a batch; None for one env.

        Raises:
            ConfigurationError: The env is not measured, or a word or a setting is unknown.
        """
        for name, given, allowed in (
            ("observe", observe, OBSERVATIONS),
            ("knowledge", knowledge, ("model", "plant")),
        ):
            if given not in allowed:
                raise ConfigurationError(f"{name} = {shown(given)}; {nearest(str(given), allowed)}")
        self.problem, self.viewer = inner.problem, inner.viewer
        self.estimator = make_estimator(estimator, self.problem, knowledge)
        self.tracker = BeliefTracker(self.estimator, num_envs)
        self._measured_env, self._sees_estimate = inner, observe == "estimate"
        flavour: Flavour = "floats" if num_envs is None else "arrays"
        features = [f.expression for f in self.problem.features]
        self._features = compile_function((*self.problem.plant.states, TIME), features, flavour)
        self._box = observation_box(self.problem.unmeasured)

    @property
    def components(self) -> Components:
        """Components of the estimate, from which a filter decides."""
        return tuple(self.tracker.mean)

    @property
    def sent(self) -> Sequence[Any]:
        """Components of the physical inputs that the last step was given."""
        return self._measured_env.sent

    @property
    def executed(self) -> Sequence[Any]:
        """Components of those that were executed in it."""
        return self._measured_env.executed

    def physical_action(self, action: Any) -> Any:
        """Scale actions in [-1, 1] to the physical inputs; see the env's method."""
        return self._measured_env.physical_action(action)

    def normalized_action(self, physical: Sequence[Any]) -> np.ndarray:
        """Invert `physical_action`."""
        return self._measured_env.normalized_action(physical)

    def features_at_estimate(self, times: Any) -> np.ndarray:
        """Return the problem's features at the estimate, float32 (k,) or (num_envs, k).

        Args:
            times: since the start of the episode, in s.
        """
        values = self._features(*self.tracker.mean, times)
        size = np.size(times)
        table = stacked(values, size).astype(np.float32)
        found = np.clip(table, self._box.low, self._box.high)
        return found[0] if np.ndim(times) == 0 else found

    def estimated(self, x: Sequence[Any]) -> Info:
        """Return what the estimator adds to the info, with the batch in front.

        Args:
            x: components of the true states, arrays (B,).
        """
        tracker, n = self.tracker, self.estimator.n
        size = len(np.atleast_1d(x[0]))
        mean = stacked(tracker.mean, size)
        covariance = unpacked([np.broadcast_to(c, size) for c in tracker.covariance], n).reshape(
            size, n, n
        )
        values, freedom = nees(self.estimator, stacked(x, size), mean, covariance)
        received = np.stack([np.broadcast_to(r, size) for r in tracker.received], axis=-1)
        return {
            "estimate": mean,
            "estimate_covariance": covariance,
            "innovation": stacked(tracker.innovation, size),
            "nees": values,
            "nees_dof": freedom,
            "nis": np.array(np.broadcast_to(tracker.nis, size), dtype=float),
            "nis_dof": received.sum(axis=1),
            "lost": np.array(np.broadcast_to(tracker.lost, size), dtype=np.int64),
        }


def require_truth_below(problem: Any, layer: Any) -> None:
    """Raise ConfigurationError where a filter would read the true state of a measured env.

    Args:
        problem: of the env.
        layer: that a filter reads the state from.
    """
    if problem.measurement is not None and not isinstance(layer, EstimatorLayer):
        raise ConfigurationError(
            f"{problem.name} is measured, so that a filter does not know its state; give"
            " estimator='ekf' (or kf, ukf), or make the env without measurement"
        )


class StateEstimatorWrapper(
    EstimatorLayer,
    gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    gym.utils.RecordConstructorArgs,
):
    """Estimates the state of an env with the option `measurement`, for policies and filters.

    Filters above it decide at the estimate. `info` gains the keys of `safe_envs.envs.info`; cost
    and violations remain those of the true state. A state that is set or given at a reset is not
    told to the estimator: its first belief is the start distribution of the problem.

    Args:
        env: one of this project's envs with a `measurement`, possibly wrapped.
        estimator: "kf", "ekf" or "ukf", with settings like "ekf:process_noise=.1"; or an
            `Estimator`.
        observe: "estimate" for the features of the env without a sensor, at the estimate, so that
            policies of the true state act on the estimate; "measurement" for what is measured.
        knowledge: "model" (what the designer believes) or "plant" (the true system).

    Raises:
        ConfigurationError: an argument is unknown, or the env is not measured.
        SystemDefinitionError: the measurement does not determine the state.
    """

    def __init__(
        self,
        env: gym.Env[np.ndarray, np.ndarray],
        estimator: Estimator | str = "ekf",
        observe: str = "estimate",
        knowledge: str = "model",
    ) -> None:
        inner = state_layer(env, (SafeEnv,), vector=False, wrapper="StateEstimator")
        self.attach(inner, estimator, observe, knowledge)
        gym.utils.RecordConstructorArgs.__init__(
            self, estimator=self.estimator.text, observe=observe, knowledge=knowledge
        )
        gym.Wrapper.__init__(self, env)
        if self._sees_estimate:
            self.observation_space = self._box
        self._directly = only_checks_between(env, inner)

    @property
    def episode(self) -> Episode:
        """Counters of the episode."""
        return self._measured_env.episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start an episode; see `SafeEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.tracker.begin(self._measured_env.measured)
        return self._seen(observation), {**info, **self._report()}

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """Hold an action for one control period, and take in the sample at its end."""
        return self._followed(self.env.step(action))

    def step_physical(self, u: Sequence[float]) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """Step with a physical input inside its bounds, as a filter returns it."""
        if self._directly:
            return self._followed(self._measured_env.step_physical(u))
        return self.step(self.normalized_action(u))

    def _followed(self, found: Any) -> tuple[np.ndarray, Any, bool, bool, Info]:
        observation, reward, terminated, truncated, info = found
        self.tracker.advance(self._measured_env.executed, self._measured_env.measured)
        info.update(self._report())
        return self._seen(observation), reward, terminated, truncated, info

    def _seen(self, observation: np.ndarray) -> np.ndarray:
        if not self._sees_estimate:
            return observation
        return self.features_at_estimate(self.episode.steps * self.problem.dt)

    def _report(self) -> Info:
        each = self.estimated([np.array([c]) for c in self._measured_env.components])
        return {key: value[0] if value.ndim > 1 else value[0].item() for key, value in each.items()}


class StateEstimatorVectorWrapper(EstimatorLayer, gym.vector.VectorWrapper):
    """`StateEstimatorWrapper` for a batch: same arguments, same info with the batch in front.

    Estimators restart with the episodes of their envs, in every mode of autoreset.

    Attributes:
        last_states: with same-step autoreset, the estimates at the end of the episodes that ended
            last, (num_envs, n); of the other envs anything.
        last_covariance: likewise, components of the covariances.
    """

    def __init__(
        self,
        env: gym.vector.VectorEnv,
        estimator: Estimator | str = "ekf",
        observe: str = "estimate",
        knowledge: str = "model",
    ) -> None:
        inner = state_layer(env, (SafeVectorEnv,), vector=True, wrapper="StateEstimator")
        self.attach(inner, estimator, observe, knowledge, env.num_envs)
        gym.vector.VectorWrapper.__init__(self, env)
        if self._sees_estimate:
            self.single_observation_space = self._box
            self.observation_space = batch_space(self._box, env.num_envs)
        self.autoreset_mode = env.metadata["autoreset_mode"]
        self.last_states = np.empty((env.num_envs, 0))
        self.last_covariance: Sequence[Any] = ()

    @property
    def episodes(self) -> Episodes:
        """Counters of the episodes."""
        return self._measured_env.episodes

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start episodes in every env, or those of a mask; see `SafeVectorEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        present = info["_cost"]
        self.tracker.begin(self._measured_env.measured, present)
        added = self.estimated(self._measured_env.components)
        return self._seen(observation), {**info, **with_masks(added, present)}

    def step(self, actions: Any) -> VectorStep:
        """Hold an action in each env for one control period, and take in the samples."""
        return self._followed(self.env.step(actions))

    def step_physical(self, u: Sequence[Any]) -> VectorStep:
        """Step with components of physical inputs inside their bounds, as a filter returns them."""
        if self.env is self._measured_env:
            return self._followed(self._measured_env.step_physical(u))
        return self.step(self.normalized_action(u))

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return that of the env, with the beliefs; see `SafeVectorEnv.snapshot`."""
        return {**self._measured_env.snapshot(), **self.tracker.snapshot()}

    def restore(self, snapshot: Mapping[str, np.ndarray], seed: Any = None) -> None:
        """Put each episode where a snapshot has it; see `SafeVectorEnv.restore`."""
        self._measured_env.restore(snapshot, seed)
        self.tracker.restore(snapshot)

    def _followed(self, found: VectorStep) -> VectorStep:
        observation, reward, terminated, truncated, info = found
        world, begun = self._measured_env, self.episodes.begun
        restarts = np.count_nonzero(begun) > 0
        same_step = restarts and self.autoreset_mode == AutoresetMode.SAME_STEP
        sample = world.measured
        if same_step:
            sample = merged(begun, self.episodes.last_sample, sample)
        self.tracker.advance(world.executed, sample)
        if same_step:
            self._tell_last(info, begun)
        if restarts:
            self.tracker.begin(world.measured, begun)
        info.update(with_masks(self.estimated(world.components), info["_cost"]))
        return self._seen(observation), reward, terminated, truncated, info

    def _tell_last(self, info: Info, ended: np.ndarray) -> None:
        """Report the estimates of the last states of episodes that ended."""
        self.last_states = stacked(self.tracker.mean, self.num_envs)
        self.last_covariance = self.tracker.covariance
        last = self.estimated(list(self.episodes.last_states.T))
        info["final_info"].update(with_masks(last, ended))
        if self._sees_estimate:
            seen = self.features_at_estimate(self.episodes.last_steps * self.problem.dt)
            for i in np.flatnonzero(ended).tolist():
                info["final_obs"][i] = seen[i]

    def _seen(self, observation: np.ndarray) -> np.ndarray:
        if not self._sees_estimate:
            return observation
        return self.features_at_estimate(self.episodes.steps * self.problem.dt)


class BeliefValues:
    """The values of a belief that a filter takes at run time.

    Args:
        safety_filter: with conditions that have `belief`.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        self._filter = safety_filter
        self._places = safety_filter.belief_places
        self._spread = len(belief_symbols(safety_filter.model.n)[0])

    def at(self, x: Sequence[Any], tracker: BeliefTracker, u: Sequence[Any]) -> Sequence[Any]:
        """Return the components from which the filter decides.

        Args:
            x: of the estimate.
            tracker: of the belief.
            u: of the proposed input.
        """
        believed = tracker.believed(u)
        return (*x, *[believed[place] for place in self._places])

    def barriers(self, x: Sequence[Any], covariance: Sequence[Any]) -> np.ndarray:
        """Return the belief barriers, shape (B, k).

        Args:
            x: components of the estimates, floats or arrays (B,).
            covariance: components of their covariances.
        """
        size = len(np.atleast_1d(x[0]))
        # They do not depend on the rates of the covariance.
        values = [
            np.atleast_1d(covariance[place]) if place < self._spread else np.zeros(size)
            for place in self._places
        ]
        found = self._filter.barriers_at([*map(np.atleast_1d, x), *values])
        return stacked(found, size)


def belief_values_of(safety_filter: Any, estimator: Estimator | None) -> BeliefValues | None:
    """Return what a filter is given of a belief; None where it needs nothing.

    Args:
        safety_filter: any filter.
        estimator: of the state that it is given, if that is an estimate.

    Raises:
        ConfigurationError: It has belief conditions, and the state is the true one.
    """
    if not isinstance(safety_filter, SafetyFilter):
        return None
    if all(condition.belief is None for _, condition in safety_filter.pairs):
        return None
    if estimator is None:
        raise ConfigurationError(
            "a condition with belief is for estimates, and this filter knows the true state: make"
            " the env with measurement='default' and give estimator='ekf', or leave belief out"
        )
    return BeliefValues(safety_filter)
