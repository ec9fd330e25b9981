"""What a state estimator over an env is, whether that is one env or a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Components, Flavour, compile_function, stacked
from safe_envs.envs.info import Info
from safe_envs.envs.spaces import observation_box
from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.independent_copies import IndependentCopies
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.estimation import BeliefTracker, Estimator, make_estimator
from safe_envs.wrappers.estimation.consistency import nees
from safe_envs.wrappers.estimation.packed import unpacked

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
