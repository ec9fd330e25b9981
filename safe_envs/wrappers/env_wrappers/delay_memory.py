"""A filter of envs whose inputs are under way for a while before they are executed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safe_envs.compiled.data import Data
from safe_envs.compiled.program import Source
from safe_envs.dynamics.codegen import Components
from safe_envs.envs.delay_line import DelayLine
from safe_envs.errors import NotCompilableError
from safe_envs.problem.actuators import resting_input
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions import spec_of
from safe_envs.wrappers.filter_qp import FilterDecision
from safe_envs.wrappers.prediction import Prediction
from safe_envs.wrappers.safety_filter import SafetyFilter

_KEY = "filter_under_way"


class DelayMemory:
    """A filter that decides at the predicted state; see `DelayedFilter` and `EpisodeFilter`.

    It remembers what it sent itself: the delay that it believes need not be that of the env.

    Args:
        safety_filter: which decides.
        problem: of the envs.
        delay: that is believed, in control periods.
        num_envs: size of the batch.

    Attributes:
        safety_filter: as given.
        text: of its conditions.
    """

    judges_episodes = False

    def __init__(
        self, safety_filter: SafetyFilter, problem: SafetyProblem, delay: int, num_envs: int
    ) -> None:
        self.safety_filter = safety_filter
        self.text = spec_of([each for _, each in safety_filter.pairs])
        self._prediction = Prediction(safety_filter.model, problem.dt, problem.substeps)
        rest = resting_input(problem.box)
        self._one, self._batch = DelayLine(delay, rest), DelayLine(delay, rest, num_envs)

    def begin(self, x: Sequence[Any], envs: np.ndarray | None = None, instants: Any = 0) -> None:
        """Put resting inputs under way.

        Args:
            x: not used.
            envs: which begin an episode, bool (num_envs,); None for all.
            instants: not used.
        """
        self._batch.restart(envs)
        if envs is None or len(envs) == 1:
            self._one.restart()

    def resume(self, x: Sequence[Any], envs: np.ndarray, instants: Any) -> None:
        """Do nothing: what is under way goes on, as in an env whose state is set.

        Args:
            x: not used.
            envs: not used.
            instants: not used.
        """

    def decide_floats(self, x: Sequence[float], u: Sequence[float]) -> FilterDecision:
        """Decide for one env; see `DelayedFilter.filter`.

        Args:
            x: n components of the state.
            u: m components of the proposed input.

        Returns:
            The decision at the predicted state.
        """
        decision = self.safety_filter.decide_floats(
            self._prediction.of_one(x, self._one.under_way), u
        )
        self._one.exchange(decision.action)
        return decision

    def decide_arrays(self, x: Components, u: Components) -> FilterDecision:
        """Decide for the batch; see `decide_floats`.

        Args:
            x: components (num_envs,) of the states.
            u: of the proposed inputs.

        Returns:
            The decisions at the predicted states.
        """
        decision = self.safety_filter.decide_arrays(
            self._prediction.of_batch(x, self._batch.under_way), u
        )
        self._batch.exchange(decision.action)
        return decision

    def advance(self, x: Sequence[Any], ended: Any) -> None:
        """Do nothing.

        Args:
            x: not used.
            ended: not used.
        """

    def report(self) -> dict[str, Any]:
        """Return nothing."""
        return {}

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
