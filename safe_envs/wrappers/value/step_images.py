"""Where a step takes a cell, or a state: boxes of coordinates, and how the inputs move them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.intervals import Interval, interval_function
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.value.image_source import image_function
from safe_envs.wrappers.value.noise_boxes import NoiseBoxes, noise_boxes
from safe_envs.wrappers.value.reduction import ReducedProblem
from safe_envs.wrappers.value.step_parts import scenarios, step_parts

_AT_ONCE = 2_000_000
_HUGE = 1e200

_ALONE = 20
"""Intervals of a normal that is the only one to be divided."""

_TOGETHER = 200
_FEWEST, _MOST = 4, 40
"""Intervals of each of several normals; their boxes are so many together, about."""

_SAMPLES = 256


class StepImages(NamedTuple):
    """Where a step takes some states; see `bellman_kernel`.

    Attributes:
        images: shape (B, 1 or U, R, W, n, 2).
        effects: shape (B, R, n, m, 2).
    """

    images: np.ndarray
    effects: np.ndarray


class Step:
    """One sub-step of a reduced problem over boxes of its coordinates.

    Noise of constant size along one coordinate alone is left to `smoothing`, which is exact; all
    other noise is divided into boxes.

    Args:
        reduced: the problem.

    Raises:
        ConfigurationError: A control period has several sub-steps, which share one input.

    Attributes:
        blur: standard deviation of the noise along each coordinate that is left out here.
        noise: boxes of all other noise.
        is_affine: whether inputs move the images in proportion.
        parts: of the step, as expressions.
    """

    def __init__(self, reduced: ReducedProblem) -> None:
        if reduced.substeps > 1:
            raise ConfigurationError(
                f"{reduced.problem.name} has substeps = {reduced.substeps}: values are computed for"
                " problems whose control period is one integration step; take substeps = 1"
            )
        self._reduced = reduced
        self.parts = step_parts(reduced)
        self.blur, self.is_affine = self.parts.blur, self.parts.is_affine
        self._scenarios = scenarios(reduced.intervals)
        self.noise: NoiseBoxes = noise_boxes(self._intervals())

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the compiled kernel, which a copy makes itself."""
        return {key: value for key, value in vars(self).items() if key != "_kernel"}

    @property
    def substeps(self) -> int:
        """Sub-steps of a control period."""
        return self._reduced.substeps

    @property
    def is_noisy(self) -> bool:
        """Whether a step has noise."""
        return bool(self._reduced.noise)

    @property
    def scenarios(self) -> int:
        """Number of boxes of the uncertain parameters."""
        return len(self._scenarios)

    @cached_property
    def depends_on_time(self) -> bool:
        """Whether states that are known in advance occur in the step."""
        used = set().union(*(e.free_symbols for e in self.parts.expressions))
        return bool(used & set(self._reduced.known))

    @cached_property
    def _functions(self) -> tuple[Any, Any]:
        reduced, parts = self._reduced, self.parts
        symbols = (
            *(c.symbol for c in reduced.coordinates),
            *reduced.known,
            *reduced.intervals,
        )
        effects = [entry for row in parts.effect for entry in row]
        return (
            interval_function((*symbols, *parts.boxed, *reduced.inputs), parts.rest),
            interval_function(symbols, effects),
        )

    def _intervals(self) -> list[int]:
        """Return numbers of intervals of the boxed normals.

        The more one of them moves the coordinates, as parts of their ranges, the more it has.
        """
        reduced, channels = self._reduced, len(self.parts.boxed)
        if channels < 2:
            return [_ALONE] * channels
        rng = np.random.default_rng(0)
        extents = [c.period or c.high - c.low for c in reduced.coordinates]
        points = [
            (0.0 if c.period else c.low) + extent * rng.random(_SAMPLES)
            for c, extent in zip(reduced.coordinates, extents, strict=True)
        ]
        known = [float(values[0]) for values in reduced.known.values()]
        world = [0.5 * (low + high) for low, high in reduced.intervals.values()]
        middle = [0.5 * (low + high) for low, high in reduced.box]
        sizes = np.zeros(channels)
        for j in range(channels):
            up, down = (
                self._functions[0](
                    [*points, *known, *world, *(sign * (i == j) for i in range(channels)), *middle]
                )
                for sign in (1.0, -1.0)
            )
            moved = [
                np.mean(np.minimum(np.abs(a.high - b.low), extent)) / extent
                for a, b, extent in zip(up, down, extents, strict=True)
            ]
            sizes[j] = max(moved)
        shares = np.maximum(sizes, 1e-3 * sizes.max()) / np.maximum(sizes.max(), 1e-300)
        scale = (_TOGETHER / np.prod(shares)) ** (1.0 / channels)
        return [int(min(max(round(scale * share), _FEWEST), _MOST)) for share in shares]

    def images(
        self,
        low: Sequence[np.ndarray],
        high: Sequence[np.ndarray],
        inputs: np.ndarray,
        instant: int = 0,
    ) -> StepImages:
        """Return where boxes of states go.

        Args:
            low: least coordinates, n arrays (B,).
            high: largest coordinates.
            inputs: ends of the inputs, shape (1 or B, V, m, 2), for steps that are not affine.
            instant: number of the sub-step, for states that are known in advance.
        """
        count, n, m = len(low[0]), len(low), len(self._reduced.inputs)
        tried = 1 if self.is_affine else inputs.shape[1]
        scenarios, boxes = len(self._scenarios), len(self.noise.weights)
        images = np.empty((count, tried, scenarios, boxes, n, 2))
        effects = np.empty((count, scenarios, n, m, 2))
        size = max(1, _AT_ONCE // (tried * scenarios * boxes))
        for first in range(0, count, size):
            part = slice(first, first + size)
            own = inputs[part] if len(inputs) > 1 else inputs
            ends = [Interval(a[part], b[part]) for a, b in zip(low, high, strict=True)]
            self._fill(images[part], effects[part], ends, own, instant)
        return StepImages(images, effects)

    @cached_property
    def _kernel(self) -> Any:
        reduced, parts = self._reduced, self.parts
        symbols = {
            "points": reduced.symbols,
            "known": tuple(reduced.known),
            "worlds": tuple(reduced.intervals),
            "noise": parts.boxed,
            "inputs": reduced.inputs,
        }
        return image_function(symbols, parts.rest, parts.effect)

    @cached_property
    def worlds(self) -> np.ndarray:
        """Ends of the uncertain parameters in each scenario, shape (R, S, 2)."""
        return np.array(self._scenarios, dtype=float).reshape(len(self._scenarios), -1, 2)

    def of_points(self, q: Sequence[np.ndarray], inputs: np.ndarray, instant: int) -> StepImages:
        """Return where states go; see `images`.

        Args:
            q: coordinates, n arrays (B,).
            inputs: ends of the inputs, shape (1 or B, V, m, 2), for steps that are not affine.
            instant: number of the sub-step.
        """
        if self._kernel is None:
            return self.images(q, q, inputs, instant)
        n, m, scenarios = len(q), len(self._reduced.inputs), len(self._scenarios)
        tried, noise, points = 1 if self.is_affine else inputs.shape[1], self.noise, np.array(q)
        images = np.empty((points.shape[1], tried, scenarios, len(noise.weights), n, 2))
        effects = np.empty((points.shape[1], scenarios, n, m, 2))
        known = np.array([values[instant] for values in self._reduced.known.values()], dtype=float)
        self._kernel(
            0, points.shape[1], points, known, self.worlds, noise.low, noise.high, inputs, images,
            effects,
        )  # fmt: skip
        return StepImages(images, effects)

    def _fill(
        self,
        images: np.ndarray,
        effects: np.ndarray,
        coordinates: Sequence[Interval],
        inputs: np.ndarray,
        instant: int,
    ) -> None:
        rest, effect = self._functions
        m = effects.shape[3]
        known = [float(values[instant]) for values in self._reduced.known.values()]
        wide = [
            Interval(c.low[:, None, None, None], c.high[:, None, None, None]) for c in coordinates
        ]
        worlds = [
            Interval(
                np.array([s[i][0] for s in self._scenarios])[:, None],
                np.array([s[i][1] for s in self._scenarios])[:, None],
            )
            for i in range(len(self._reduced.intervals))
        ]
        noise = [Interval(a, b) for a, b in zip(self.noise.low, self.noise.high, strict=True)]
        given = (
            [Interval(np.float64(0.0), np.float64(0.0))] * m
            if self.is_affine
            else [Interval(*np.moveaxis(inputs[:, :, j, :, None, None], 2, 0)) for j in range(m)]
        )
        for i, found in enumerate(rest([*wide, *known, *worlds, *noise, *given])):
            images[..., i, 0], images[..., i, 1] = found.low, found.high
        flat = [Interval(c.low[:, None], c.high[:, None]) for c in coordinates]
        thin = [Interval(w.low[:, 0], w.high[:, 0]) for w in worlds]
        for i, found in enumerate(effect([*flat, *known, *thin])):
            # An infinite effect of an input that is 0 would be no number.
            effects[:, :, i // m, i % m, 0] = np.maximum(found.low, -_HUGE)
            effects[:, :, i // m, i % m, 1] = np.minimum(found.high, _HUGE)
