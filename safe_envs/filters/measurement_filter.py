"""A safety filter that is given measurements in place of states."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np

from safe_envs.arrays import real_array
from safe_envs.envs.sensor import Sample
from safe_envs.errors import ConfigurationError, InvalidInputError, shown
from safe_envs.filters.arguments import doubles
from safe_envs.filters.conditions.estimates import belief_symbols
from safe_envs.filters.estimation.estimator import Estimator, require_fixed, unpacked
from safe_envs.filters.estimation.tracker import BeliefTracker
from safe_envs.filters.qp import FilterDecision


def components_of(values: np.ndarray) -> Sequence[Any]:
    """Return components of arrays (..., k): floats of one, arrays (B,) of a batch, copied."""
    if values.ndim == 1:
        return values.tolist()
    return list(np.array(values.reshape(-1, values.shape[-1]).T, order="C"))


class MeasurementFilter:
    """A `SafetyFilter` at the estimate of an estimator, from measurement to measurement.

    Each call of `filter` stands for a control period: it takes in a measurement and decides the
    input until the next one, with which the estimate is predicted then. Conditions with `belief`
    get what they need of the belief. What was sent in place of a decision is said by `override`,
    also after a call that raised.

    Args:
        safety_filter: decides at the estimate.
        estimator: of its state, with an initial belief.
    """

    def __init__(self, safety_filter: Any, estimator: Estimator) -> None:
        if estimator.model.states != safety_filter.model.states:
            raise ConfigurationError(
                "the estimator is of other states than the filter; make both for one system"
            )
        require_fixed(estimator.model, estimator.measurement, safety_filter.qp.runtime)
        symbols = [s.name for group in belief_symbols(estimator.n) for s in group]
        self._believed = {symbols[place]: place for place in safety_filter.belief_places}
        self._filter: Any = safety_filter
        self.estimator = estimator
        # Shows at once whether the estimator has a belief to begin with.
        self._tracker = BeliefTracker(estimator)
        self.reset()

    def reset(self) -> None:
        """Begin an episode, with the estimator's initial belief."""
        self._batch: tuple[int, ...] | None = None
        self._sent: Any = None
        self._waiting = False

    @property
    def mean(self) -> np.ndarray:
        """The estimate, shape (..., n)."""
        found = np.stack(self._known.mean, axis=-1)
        return found.reshape(*(self._batch or ()), self.estimator.n)

    @property
    def covariance(self) -> np.ndarray:
        """The covariance of its error, shape (..., n, n)."""
        n = self.estimator.n
        return unpacked(self._known.covariance, n).reshape(*(self._batch or ()), n, n)

    @property
    def lost(self) -> Any:
        """How many values were lost since the reset, of all channels."""
        return copy(self._known.lost)

    @property
    def tracker(self) -> BeliefTracker:
        """The belief as components, with the last innovation."""
        return self._known

    def filter(
        self,
        y: Any,
        u_nominal: Any,
        *,
        input_bounds: Any = None,
        parameters: Mapping[Any, Any] | None = None,
        t: Any = None,
    ) -> FilterDecision:
        """Take in a measurement, and decide at the estimate.

        Args:
            y: measured values, shape (k,) or (..., k), of the same plants at every call until
                `reset`; NaN where a value was lost.
            u_nominal: proposed inputs in physical units, shape (m,) or (..., m).
            input_bounds: see `SafetyFilter.filter`.
            parameters: see there; those of the belief are not given.
            t: see there.

        Returns:
            The decision; its barriers are those of the estimate, or of the belief.

        Raises:
            InvalidInputError: A shape does not fit, or an entry is infinite.
            ConfigurationError: See `SafetyFilter.filter`; or it is not known what was sent after a
                call that raised.
            NumericalError: The estimate or the constraint has no finite value.
        """
        values, u = self._measured(y), doubles("nominal input", u_nominal)
        batch, m = values.shape[:-1], self.estimator.model.m
        if u.shape != (*batch, m):
            raise InvalidInputError(
                f"measurement {values.shape} and input {u.shape} do not fit; give (..., k) and"
                f" (..., {m}) with the same leading axes"
            )
        self._take_in(values, batch)
        self._waiting = True
        given = dict(parameters or {})
        if self._believed:
            found = self._known.believed(components_of(u))
            given |= {name: np.reshape(found[at], batch) for name, at in self._believed.items()}
        decision = self._filter.filter(
            self.mean, u, input_bounds=input_bounds, parameters=given or None, t=t
        )
        self._sent, self._waiting = components_of(decision.action), False
        return decision

    def override(self, u: Any) -> None:
        """Say what was sent in place of the last decision, or after a call that raised.

        Args:
            u: shape (m,) or (..., m).

        Raises:
            InvalidInputError: The shape does not fit, or an entry is no finite real number.
            ConfigurationError: Nothing was measured since the reset.
        """
        given = doubles("input", u)
        if self._batch is None:
            raise ConfigurationError("nothing was sent since the reset: call filter() first")
        if given.shape != (*self._batch, self.estimator.model.m) or not np.isfinite(given).all():
            raise InvalidInputError(
                f"the input {shown(u)} does not fit; give finite numbers of shape"
                f" {(*self._batch, self.estimator.model.m)}"
            )
        self._sent, self._waiting = components_of(given), False

    @property
    def _known(self) -> BeliefTracker:
        if self._batch is None:
            raise ConfigurationError("nothing was measured since the reset: call filter() first")
        return self._tracker

    def _measured(self, y: Any) -> np.ndarray:
        values = real_array("measurement", y).astype(np.float64)
        k = len(self.estimator.measurement.channels)
        if values.ndim == 0 or values.shape[-1] != k or np.isinf(values).any():
            names = ", ".join(c.name for c in self.estimator.measurement.channels)
            raise InvalidInputError(
                f"the measurement {shown(y)} does not fit; give numbers of shape (..., {k}), NaN"
                f" where a value was lost: {names}"
            )
        if self._batch is not None and values.shape[:-1] != self._batch:
            raise InvalidInputError(
                f"the measurement has the leading axes {values.shape[:-1]}, and the belief is of"
                f" {self._batch}: call reset() before other plants are filtered"
            )
        return values

    def _take_in(self, values: np.ndarray, batch: tuple[int, ...]) -> None:
        parts = components_of(values)
        # A value that is not finite counts as lost.
        sample = Sample(parts, [True if not batch else np.ones(len(p), dtype=bool) for p in parts])
        if self._batch is None:
            self._tracker = BeliefTracker(self.estimator, math.prod(batch) if batch else None)
            self._tracker.begin(sample)
            self._batch = batch
            return
        if self._waiting or self._sent is None:
            raise ConfigurationError(
                "it is not known what was sent in the last control period, since an error took the"
                " place of a decision: call override(u) with that, or reset()"
            )
        self._tracker.advance(self._sent, sample)
        self._sent = None


def certain_states(estimator: Any) -> tuple[int, ...]:
    """Return the places of the states without any uncertainty.

    Args:
        estimator: as users give it; None for none.

    Raises:
        ConfigurationError: It is no estimator.
    """
    if estimator is None:
        return ()
    if not isinstance(estimator, Estimator):
        raise ConfigurationError(
            f"estimator = {shown(estimator)}; give an Estimator, such as"
            " ExtendedKalmanFilter(model, measurement, dt), or take SafetyFilter.for_problem"
            " with its text"
        )
    return estimator.certain
