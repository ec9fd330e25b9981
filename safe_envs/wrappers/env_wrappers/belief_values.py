"""What a filter with belief conditions is given of the belief, and the barriers of that."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import stacked
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.conditions.belief import belief_symbols
from safe_envs.wrappers.estimation import BeliefTracker, Estimator
from safe_envs.wrappers.safety_filter import SafetyFilter


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
