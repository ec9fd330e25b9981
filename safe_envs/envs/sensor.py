"""What a sensor reports of the states of one env or of a batch: noisy, lost and late samples."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import compile_function, filled, stacked
from safe_envs.dynamics.noise import SENSOR, Key
from safe_envs.envs.info import Info
from safe_envs.envs.noise import NoiseStream, NoiseStreams
from safe_envs.envs.spaces import observation_box
from safe_envs.envs.starts import EpisodeStreams
from safe_envs.problem.measurement import Channel, Measurement
from safe_envs.problem.problem import SafetyProblem


def wrapped(channel: Channel, value: float) -> float:
    """Return a value in (-period/2, period/2], if its channel has a period.

    Args:
        channel: of a sensor.
        value: that it measures.
    """
    period = channel.period
    if not period or not math.isfinite(value):
        return value
    return value - period * math.ceil(value / period - 0.5)


def wrapped_batch(channel: Channel, values: np.ndarray) -> np.ndarray:
    """Return the values (num_envs,) of a batch as `wrapped` does.

    Args:
        channel: of a sensor.
        values: that it measures.
    """
    period = channel.period
    return values - period * np.ceil(values / period - 0.5) if period else values


def loss_quantile(channel: Channel) -> float:
    """Return the number below which a standard normal one is with the probability of a loss."""
    return NormalDist().inv_cdf(channel.dropout) if channel.dropout else -math.inf


def value_or_nan(measure: Callable[..., Sequence[float]], x: Sequence[float]) -> float:
    """Return what is measured of a state, NaN where it has no value.

    Args:
        measure: one number of the components of a state.
        x: those components.
    """
    try:
        return measure(*x)[0]
    except (ArithmeticError, ValueError):
        return math.nan


class Sample(NamedTuple):
    """What has arrived from a sensor up to a control instant.

    Attributes:
        values: k components: floats of one env, or arrays (num_envs,) of a batch. Where nothing
            arrived at this instant, the last value that did.
        received: which arrived at this instant, bools or arrays of them.
    """

    values: Sequence[Any]
    received: Sequence[Any]


def read_only(components: Sequence[Any]) -> tuple[Any, ...]:
    """Return components that others may read, and not write to.

    Args:
        components: arrays.
    """
    found = tuple([np.asarray(component).view() for component in components])
    for component in found:
        component.flags.writeable = False
    return found


def merged(where: np.ndarray, one: Sample, other: Sample) -> Sample:
    """Return samples of a batch that are one in some envs and another elsewhere.

    Args:
        where: bool (num_envs,).
        one: of the envs where it is True.
        other: of the others.
    """
    return Sample(
        *(
            [np.where(where, a, b) for a, b in zip(*pair, strict=True)]
            for pair in zip(one, other, strict=True)
        )
    )


class _Sensor:
    """The part of a sensor that does not depend on the number of envs.

    A sample that is no finite number, such as a range beyond where its formula is defined, is lost.

    The errors of the sample of control instant i are the words 2 k i to 2 k (i + 1) of the
    episode's stream `SENSOR`: k normal numbers of the noise, and k that decide which samples are
    lost. So they depend on the seed, the episode and the instant alone.
    """

    def __init__(self, problem: SafetyProblem, measurement: Measurement, flavour: Any) -> None:
        channels = measurement.channels
        self._channels, self._delay = channels, measurement.delay
        plant = problem.plant
        self._formulas = [plant.numeric(channel.expression) for channel in channels]
        self._measure = compile_function(plant.states, self._formulas, flavour)
        # A sample is lost where its second normal number is below the quantile.
        self._lost_below = [loss_quantile(channel) for channel in channels]
        box = observation_box(problem)
        self._low, self._high = box.low, box.high
        nearest = np.clip(0.0, self._low.astype(float), self._high.astype(float))
        self._before_any: list[float] = nearest.tolist()

    @property
    def draws(self) -> int:
        """Normal numbers that a sample takes."""
        return 2 * len(self._channels)


class Sensor(_Sensor):
    """The sensor of one env.

    Attributes:
        sample: what has arrived last.

    Args:
        problem: which is measured.
        measurement: what is measured of it.
        periods: of an episode.
    """

    def __init__(self, problem: SafetyProblem, measurement: Measurement, periods: int) -> None:
        super().__init__(problem, measurement, "floats")
        self._apart = [
            compile_function(problem.plant.states, (formula,), "floats")
            for formula in self._formulas
        ]
        self._noise = NoiseStream(self.draws, periods + 1, SENSOR)
        self._nothing = Sample(self._before_any, [False] * len(self._channels))
        self._restart()

    def begin(self, key: Key, episode: int, instant: int) -> None:
        """Begin an episode.

        Args:
            key: of the seed.
            episode: its number since the seed.
            instant: control instant at which it begins.
        """
        self._noise.begin(key, episode, instant)
        self._restart()

    def observe(self, x: Sequence[float]) -> np.ndarray:
        """Take a sample of a state, and return the observation, float32 (k,)."""
        draws, k = self._noise.next(), len(self._channels)
        values = [
            wrapped(c, value + c.bias + c.noise * v)
            for c, value, v in zip(self._channels, self._readings(x), draws[:k], strict=True)
        ]
        received = [
            d >= low and math.isfinite(value)
            for d, low, value in zip(draws[k:], self._lost_below, values, strict=True)
        ]
        self._under_way.append(Sample(values, received))
        arrived = self._under_way.popleft()
        values = [
            new if has else old for new, has, old in zip(*arrived, self.sample.values, strict=True)
        ]
        self.sample = Sample(values, arrived.received)
        return np.clip(np.array(values, dtype=np.float32), self._low, self._high)

    def report(self, x: Sequence[float]) -> Info:
        """Return what a measured env adds to the info; see `safe_envs.envs.info`."""
        return {"state": np.array(x), "received": np.array(self.sample.received)}

    def _readings(self, x: Sequence[float]) -> Sequence[float]:
        """Return what is measured without an error, NaN where it has no value."""
        try:
            return self._measure(*x)
        except (ArithmeticError, ValueError):
            return [value_or_nan(measure, x) for measure in self._apart]

    def _restart(self) -> None:
        self.sample = self._nothing
        self._under_way: deque[Sample] = deque([self._nothing] * self._delay)


class BatchSensor(_Sensor):
    """The sensor of a batch of envs.

    Attributes:
        sample: what has arrived last.

    Args:
        problem: which is measured.
        measurement: what is measured of it.
        streams: of the envs.
        periods: of an episode.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        measurement: Measurement,
        streams: EpisodeStreams,
        periods: int,
    ) -> None:
        super().__init__(problem, measurement, "arrays")
        self._shape = (streams.num_envs,)
        self.noise = NoiseStreams(streams, self.draws, periods + 1, SENSOR)
        self.sample = self._nothing
        self._under_way = deque([self._nothing] * self._delay)

    @property
    def _nothing(self) -> Sample:
        values = [np.full(self._shape, value) for value in self._before_any]
        return Sample(values, [np.zeros(self._shape, dtype=bool) for _ in values])

    def begin(self, envs: np.ndarray, instants: np.ndarray | int) -> None:
        """Begin episodes, whose streams have begun.

        Args:
            envs: in which, their indices.
            instants: control instants at which they begin.
        """
        self.noise.begin(envs)
        if np.any(instants):
            self.noise.seek(envs, np.broadcast_to(instants, envs.shape))
        begun = np.zeros(self._shape, dtype=bool)
        begun[envs] = True
        nothing = self._nothing
        self._under_way = deque([merged(begun, nothing, each) for each in self._under_way])
        self.sample = merged(begun, nothing, self.sample)

    def observe(self, x: Sequence[np.ndarray], fresh: np.ndarray | None) -> np.ndarray:
        """Take a sample of the states.

        Args:
            x: components of the states.
            fresh: the envs that have just begun, of which alone a sample is taken; None for a
                sample of all.

        Returns:
            The observations, float32 (num_envs, k).
        """
        new, last = self._sampled(x, self.noise.next(fresh)), self.sample
        if fresh is None:
            self._under_way.append(new)
            arrived = self._under_way.popleft()
        else:
            arrived = new
            if self._delay:
                # Of an episode that has just begun nothing else is under way.
                self._under_way[-1] = merged(fresh, new, self._under_way[-1])
                arrived = self._nothing
            arrived = merged(fresh, arrived, last)
        values = [
            np.where(has, value, old) for value, has, old in zip(*arrived, last.values, strict=True)
        ]
        self.sample = Sample(values, arrived.received)
        seen = stacked(values, *self._shape).astype(np.float32)
        return np.clip(seen, self._low, self._high)

    def report(self, x: Sequence[np.ndarray]) -> Info:
        """Return what measured envs add to the info; see `safe_envs.envs.info`."""
        received = np.stack(self.sample.received, axis=-1)
        return {"state": stacked(x, *self._shape), "received": received}

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the samples that have arrived and those under way, in arrays."""
        samples = [self.sample, *self._under_way]
        return {
            f"sensor_{name}": np.stack([np.stack(each, axis=-1) for each in part], axis=1)
            for name, part in zip(Sample._fields, zip(*samples, strict=True), strict=True)
        }

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Take them from a snapshot."""
        parts = [np.array(snapshot[f"sensor_{name}"]) for name in Sample._fields]
        samples = [
            Sample(*(list(part[:, i].T.copy()) for part in parts)) for i in range(self._delay + 1)
        ]
        self.sample, self._under_way = samples[0], deque(samples[1:])

    def _sampled(self, x: Sequence[np.ndarray], draws: np.ndarray) -> Sample:
        k = len(self._channels)
        with np.errstate(all="ignore"):
            values = [
                wrapped_batch(c, filled(value, self._shape) + c.bias + c.noise * v)
                for c, value, v in zip(self._channels, self._measure(*x), draws[:k], strict=True)
            ]
        received = [
            (d >= low) & np.isfinite(value)
            for d, low, value in zip(draws[k:], self._lost_below, values, strict=True)
        ]
        return Sample(values, received)
