"""What an estimator believes in the episodes of one env or of a batch."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Flavour
from safe_envs.envs.sensor import Sample
from safe_envs.errors import ConfigurationError, NumericalError
from safe_envs.filters.estimation.estimator import Components, Estimator, cholesky, positive_part


class BeliefTracker:
    """Follows the belief of an estimator from sample to sample.

    Where samples arrive d control periods late, the belief that they correct is d periods old; what
    is believed now is predicted from there under the inputs since. Values that are not finite count
    as lost.

    Attributes:
        estimator: as given.
        mean: n components of what is believed now.
        covariance: n (n + 1)/2 components.
        innovation: k components of the last sample, 0 of lost ones.
        nis: normalized innovation squared of the last sample.
        received: k components, which channels the last sample had.
        lost: how many values of channels were lost in the episode; those that have not yet arrived
            do not count.

    Args:
        estimator: of the belief, with an initial one.
        num_envs: size of a batch; None for one env.

    Raises:
        ConfigurationError: The estimator has no initial belief.
    """

    def __init__(self, estimator: Estimator, num_envs: int | None = None) -> None:
        if estimator.initial is None:
            raise ConfigurationError(
                f"the estimator {estimator.text} has no belief to begin with; make it with"
                " initial=InitialBelief.of(mean, covariance), or initial_belief(problem)"
            )
        self.estimator, self._initial, self._num_envs = estimator, estimator.initial, num_envs
        self._flavour: Flavour = "floats" if num_envs is None else "arrays"
        self._delay = estimator.measurement.delay
        k = len(estimator.measurement.channels)
        # The belief that the next sample corrects.
        self._base: tuple[Components, Components] = self._start
        # Of the last periods, as many as samples are late; before an episode's first they are idle.
        idle = [self._each(0.0)] * estimator.model.m
        self._since: deque[Components] = deque([idle] * self._delay)
        self._age = self._each(0)
        self.mean, self.covariance = self._base
        self.innovation: Components = [self._each(0.0)] * k
        self.received: Components = [self._each(False)] * k
        self.nis, self.lost = self._each(0.0), self._each(0)

    def begin(self, sample: Sample, envs: np.ndarray | None = None) -> None:
        """Begin episodes, with the sample of the first control instant.

        Args:
            sample: of all envs.
            envs: which begin, bool (num_envs,); None for all.
        """
        where: Any = True if envs is None else envs
        self._base = self._where(where, self._start, self._base)
        self._age = _chosen(where, self._each(0), self._age)
        self.lost = _chosen(where, self._each(0), self.lost)
        self._correct(sample, where)
        self._look_ahead()

    def advance(self, u: Components, sample: Sample) -> None:
        """Go on by a control period.

        Args:
            u: m components of the input that was executed in it.
            sample: that arrived at its end.

        Raises:
            NumericalError: The belief has left the finite numbers.
        """
        self._since.append(tuple(u))
        self._age = self._age + 1
        moved = self.estimator.predict(self._flavour, *self._base, self._since.popleft())
        self._base = self._where(self._age > self._delay, moved, self._base)
        self._correct(sample, True)
        self._look_ahead()

    def ahead(self, u: Components) -> tuple[Components, Components]:
        """Return the covariance after the coming sample, and by how much that lowers it.

        Args:
            u: m components of the input until then.
        """
        estimator, flavour = self.estimator, self._flavour
        if not self._delay:
            return estimator.gained(flavour, *self._base, u)
        _, before = estimator.predict(flavour, self.mean, self.covariance, u)
        oldest, *since = *self._since, tuple(u)
        moved = estimator.predict(flavour, *self._base, oldest)
        mean, covariance = self._where(self._age >= self._delay, moved, self._base)
        y = estimator.expected(flavour, mean)
        arrives = self._age + 1 >= self._delay
        after = estimator.update(flavour, mean, covariance, y, [arrives] * len(y))
        _, covariance = self._predicted((after.mean, after.covariance), since, self._age + 1)
        return covariance, [b - a for b, a in zip(before, covariance, strict=True)]

    def believed(self, u: Components) -> list[Any]:
        """Return what a belief filter is given at run time; see `belief.belief_symbols`.

        These are P, its growth, and the lower triangle of G, (1, 1), (2, 1), (2, 2) and so on, with
        G G' = K S K'/dt. The growth is the positive part of (P at the next instant less P)/dt: what
        a belief loses in uncertainty is no licence to approach the edge.

        Args:
            u: m components of the input that is proposed.
        """
        dt, n = self.estimator.dt, self.estimator.n
        after, gained = self.ahead(u)
        rates = [(a - p) / dt for a, p in zip(after, self.covariance, strict=True)]
        rates = positive_part(rates, n)
        rows = cholesky([g / dt for g in gained], n)
        lower = [rows[i][j] for i in range(n) for j in range(i + 1)]
        if self._num_envs is None:
            rates, lower = ([float(entry) for entry in part] for part in (rates, lower))
        return [*self.covariance, *rates, *lower]

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the belief in arrays with the batch in front."""
        mean, covariance = self._base
        parts = {
            "base_mean": mean,
            "base_covariance": covariance,
            "mean": self.mean,
            "covariance": self.covariance,
            "innovation": self.innovation,
            "received": self.received,
        }
        found = {f"belief_{name}": np.stack(part, axis=-1) for name, part in parts.items()}
        inputs = [np.stack(u, axis=-1) for u in self._since]
        empty = np.zeros((self._size, 0, self.estimator.model.m))
        found["belief_inputs"] = np.stack(inputs, axis=-2) if inputs else empty
        counters = {"age": self._age, "lost": self.lost, "nis": self.nis}
        return found | {f"belief_{name}": np.array(value) for name, value in counters.items()}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Take the belief of a batch from a snapshot."""

        def columns(name: str) -> list[np.ndarray]:
            return list(np.moveaxis(np.array(snapshot[f"belief_{name}"]), -1, 0).copy())

        self._base = columns("base_mean"), columns("base_covariance")
        self.mean, self.covariance = columns("mean"), columns("covariance")
        self.innovation, self.received = columns("innovation"), columns("received")
        inputs = np.array(snapshot["belief_inputs"])
        self._since = deque(
            tuple(np.moveaxis(inputs[:, i], -1, 0).copy()) for i in range(inputs.shape[1])
        )
        self._age, self.lost, self.nis = (
            np.array(snapshot[f"belief_{name}"]) for name in ("age", "lost", "nis")
        )

    @property
    def _size(self) -> int:
        return 1 if self._num_envs is None else self._num_envs

    def _each(self, value: Any) -> Any:
        return value if self._num_envs is None else np.full(self._num_envs, value)

    @property
    def _start(self) -> tuple[Components, Components]:
        return self._filled(self._initial.mean), self._filled(self._initial.covariance)

    def _filled(self, values: Sequence[float]) -> Components:
        return [self._each(float(v)) for v in values]

    def _correct(self, sample: Sample, where: Any) -> None:
        """Take in a sample in some envs."""
        values, received = _usable(sample)
        has = [r & where for r in received]
        found = self.estimator.update(self._flavour, *self._base, values, has)
        self._base = self._where(where, (found.mean, found.covariance), self._base)
        self.innovation = [
            _chosen(where, new, old)
            for new, old in zip(found.innovation, self.innovation, strict=True)
        ]
        self.received = [
            _chosen(where, new, old) for new, old in zip(received, self.received, strict=True)
        ]
        self.nis = _chosen(where, found.nis, self.nis)
        missing = sum(1 - 1 * r for r in received)
        self.lost = self.lost + missing * (self._age >= self._delay) * where

    def _look_ahead(self) -> None:
        """Predict what is believed now."""
        self.mean, self.covariance = self._predicted(self._base, list(self._since), self._age)
        total = sum(map(_size_of, (*self.mean, *self.covariance)))
        if not math.isfinite(total):
            raise NumericalError(
                f"the belief of the estimator {self.estimator.text} has left the finite numbers;"
                " check the model, or give it process_noise"
            )

    def _predicted(self, belief: Any, inputs: Sequence[Components], age: Any) -> Any:
        """Predict over the last inputs, in an episode that has had `age` of them."""
        for i, u in enumerate(inputs):
            moved = self.estimator.predict(self._flavour, belief[0], belief[1], u)
            belief = self._where(age >= len(inputs) - i, moved, belief)
        return belief

    def _where(self, where: Any, one: Any, other: Any) -> Any:
        if where is True or (self._num_envs is None and where):
            return tuple(one)
        if self._num_envs is None:
            return tuple(other)
        return tuple(
            [np.where(where, a, b) for a, b in zip(*parts, strict=True)]
            for parts in zip(one, other, strict=True)
        )


def _usable(sample: Sample) -> tuple[Components, Components]:
    """Return finite values of a sample, and which of them count."""
    values, received = [], []
    for value, has in zip(sample.values, sample.received, strict=True):
        if isinstance(value, np.ndarray):
            sound = np.isfinite(value)
            values.append(value if sound.all() else np.where(sound, value, 0.0))
            received.append(has & sound)
        else:
            sound = math.isfinite(value)
            values.append(value if sound else 0.0)
            received.append(bool(has) and sound)
    return values, received


def _chosen(where: Any, one: Any, other: Any) -> Any:
    """Return one where a mask says so, and else the other; True stands for everywhere."""
    return one if where is True else np.where(where, one, other)


def _size_of(values: Any) -> float:
    return values if isinstance(values, float) else float(np.sum(values))
