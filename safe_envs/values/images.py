"""Where a step takes a cell, or a state: boxes of coordinates, and how the inputs move them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components
from safe_envs.enclosures.intervals import Interval, interval_function
from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Program, is_available
from safe_envs.errors import ConfigurationError, NotCompilableError
from safe_envs.values import image_kernel as kernels
from safe_envs.values.reduction import ReducedProblem, scenarios, step_parts
from safe_envs.values.smoothing import NoiseBoxes, noise_boxes

_LONGEST = 8
"""Exponents of powers that are products."""

_UNARY: dict[Any, Callable[..., Any]] = {
    sp.sin: kernels.ends_sine,
    sp.cos: kernels.ends_cosine,
    sp.exp: kernels.ends_exponential,
    sp.Abs: kernels.ends_magnitude,
}
_FOLDED: dict[Any, Callable[..., Any]] = {
    sp.Add: kernels.ends_sum,
    sp.Mul: kernels.ends_product,
    sp.Max: kernels.ends_larger,
    sp.Min: kernels.ends_smaller,
}

_LEVELS = 4
"""Of the loops: a state, its scenarios, their inputs, the boxes of noise."""


class ImageWriter:
    """Writes the operations of some expressions into the loop in which their values change.

    Args:
        arguments: for each symbol the number of the loop, and code for both its ends.
    """

    def __init__(self, arguments: Mapping[sp.Symbol, tuple[int, str]]) -> None:
        self.uses: list[Callable[..., Any]] = []
        self.lines: list[list[str]] = [[] for _ in range(_LEVELS)]
        self._known: dict[Any, tuple[int, str]] = {}
        for symbol, (level, code) in arguments.items():
            self._known[symbol] = level, self._named(level, code)

    def value(self, expression: Any) -> tuple[int, str]:
        """Return the loop in which an expression is at hand, and the name of its interval.

        Raises:
            NotCompilableError: There is no kernel for one of its operations.
        """
        if expression not in self._known:
            self._known[expression] = self._written(expression)
        return self._known[expression]

    def _written(self, expression: Any) -> tuple[int, str]:
        kind, parts = expression.func, expression.args
        if expression.is_number:
            low, high = _enclosure(expression)
            return 0, self._named(0, f"({low!r}, {high!r})")
        if kind in _FOLDED:
            powers = Counter(parts) if kind is sp.Mul else dict.fromkeys(parts, 1)
            operands = [p if n == 1 else sp.Pow(p, n) for p, n in powers.items()]
            # Those that change seldom come first, so that they are put together seldom.
            first, *others = sorted((self.value(p) for p in operands), key=lambda v: v[0])
            for other in others:
                first = self._call(_FOLDED[kind], first, other)
            return first
        if kind is sp.Pow:
            return self._power(*parts)
        if kind in _UNARY:
            return self._call(_UNARY[kind], self.value(parts[0]))
        if kind is sp.atan2:
            return self._call(kernels.ends_angle, *map(self.value, parts))
        raise NotCompilableError(f"there is no kernel for intervals of {kind}")

    def _power(self, base: Any, exponent: Any) -> tuple[int, str]:
        if exponent.is_number and exponent < 0:
            return self._call(kernels.ends_reciprocal, self.value(sp.Pow(base, -exponent)))
        if exponent == sp.Rational(1, 2):
            return self._call(kernels.ends_root, self.value(base))
        if not exponent.is_Integer or exponent > _LONGEST:
            raise NotCompilableError(f"there is no kernel for the power {exponent}")
        if exponent % 2:
            rest = self.value(base) if exponent == 1 else self.value(sp.Pow(base, exponent - 1))
            return (
                rest if exponent == 1 else self._call(kernels.ends_product, rest, self.value(base))
            )
        half = self.value(base if exponent == 2 else sp.Pow(base, exponent / 2))
        return self._call(kernels.ends_square, half)

    def _call(self, kernel: Callable[..., Any], *operands: tuple[int, str]) -> tuple[int, str]:
        if kernel not in self.uses:
            self.uses.append(kernel)
        level = max(operand[0] for operand in operands)
        names = ", ".join(operand[1] for operand in operands)
        return level, self._named(level, f"{kernel.__name__}({names})")

    def _named(self, level: int, code: str) -> str:
        name = f"v{sum(map(len, self.lines))}"
        self.lines[level].append(f"{name} = {code}")
        return name


def image_source(
    symbols: Mapping[str, Sequence[sp.Symbol]],
    rest: Sequence[sp.Expr],
    effect: Sequence[Sequence[sp.Expr]],
) -> Source:
    """Return the kernel `state_images` of a step.

    Args:
        symbols: of "points", "known", "worlds", "noise" and "inputs".
        rest: of each coordinate; see `Step`.
        effect: of each coordinate and input, with neither noise nor inputs.

    Raises:
        NotCompilableError: There is no kernel for one of the operations.
    """
    used = set().union(*(e.free_symbols for e in (*rest, *(e for row in effect for e in row))))
    codes = {
        "points": (0, "(points[{0}, a], points[{0}, a])"),
        "known": (0, "(known[{0}], known[{0}])"),
        "worlds": (1, "(worlds[r, {0}, 0], worlds[r, {0}, 1])"),
        "inputs": (2, "(inputs[b, v, {0}, 0], inputs[b, v, {0}, 1])"),
        "noise": (3, "(low[{0}, w], high[{0}, w])"),
    }
    arguments = {
        symbol: (codes[kind][0], codes[kind][1].format(i))
        for kind, given in symbols.items()
        for i, symbol in enumerate(given)
        if symbol in used
    }
    writer = ImageWriter(arguments)
    moved = [writer.value(e)[1] for e in rest]
    effects = [
        (i, j, writer.value(e)[1]) for i, row in enumerate(effect) for j, e in enumerate(row)
    ]
    lines = writer.lines
    for i, j, name in effects:
        # An infinite effect of an input that is 0 would be no number.
        lines[1].append(f"effects[a, r, {i}, {j}, 0] = max({name}[0], -1e200)")
        lines[1].append(f"effects[a, r, {i}, {j}, 1] = min({name}[1], 1e200)")
    for i, name in enumerate(moved):
        lines[3].append(f"images[a, v, r, w, {i}, 0] = {name}[0]")
        lines[3].append(f"images[a, v, r, w, {i}, 1] = {name}[1]")
    loops = (
        "b = a if inputs.shape[0] > 1 else 0",
        "for r in range(images.shape[2]):",
        "for v in range(images.shape[1]):",
        "for w in range(images.shape[3]):",
    )
    code = ["def state_images(a, points, known, worlds, low, high, inputs, images, effects):"]
    for level, (loop, own) in enumerate(zip(loops, lines, strict=True)):
        code.append("    " * max(level, 1) + loop)
        code += ["    " * (level + 1) + line for line in own]
    return Source("\n".join(code) + "\n", tuple(writer.uses))


def image_function(
    symbols: Mapping[str, Sequence[sp.Symbol]],
    rest: Sequence[sp.Expr],
    effect: Sequence[Sequence[sp.Expr]],
) -> Callable[..., None] | None:
    """Return `point_images` of a step; None without Numba, or without a kernel for an operation.

    Args:
        symbols: see `image_source`, as for all others.
        rest: see there.
        effect: see there.
    """
    if not is_available():
        return None
    try:
        program = Program(
            "steps of states", (kernels.point_images,), image_source(symbols, rest, effect)
        )
        return program.compiled()["point_images"]
    except NotCompilableError:
        return None


def _enclosure(number: Any) -> tuple[float, float]:
    """Return floats around a real number."""
    exact = number.is_Rational or number.is_Float
    value = float(number if exact else sp.N(number, 40))
    if not math.isfinite(value):
        raise NotCompilableError(f"{number} is no finite number")
    if exact and sp.Rational(number) == sp.Rational(value):
        return value, value
    return math.nextafter(value, -math.inf), math.nextafter(value, math.inf)


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
        """Return numbers of intervals of the boxed normals."""
        # The more one of them moves the coordinates, as parts of their ranges, the more it has.
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


class StepValues(Protocol):
    """What the filter asks of a table and its problem, for B states at control instants k (B,).

    Attributes:
        steps: K.
        inputs: those that are scanned, shape (U, m).
    """

    steps: int
    inputs: np.ndarray

    def values(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return L_k(x), shape (B,), 0 outside the safe set.

        Args:
            k: control instants, int (B,).
            x: n components of the states, arrays (B,).
        """
        ...

    def expected(self, k: np.ndarray, x: Components, u: np.ndarray) -> np.ndarray:
        """Return q_k(x, u), shape (B, V).

        Args:
            k: control instants, int (B,).
            x: n components of the states, arrays (B,).
            u: inputs in physical units, shape (B, V, m).
        """
        ...

    def scanned(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return q_k(x, u) at all scanned inputs, shape (B, U).

        Args:
            k: control instants, int (B,).
            x: n components of the states, arrays (B,).
        """
        ...

    def best_input(self, k: np.ndarray, x: Components) -> tuple[np.ndarray, np.ndarray]:
        """Return the inputs of the largest q_k, shape (B, m), and these q_k, shape (B,).

        Args:
            k: control instants, int (B,).
            x: n components of the states, arrays (B,).
        """
        ...

    def sufficient(
        self, k: np.ndarray, x: Components, u: np.ndarray, levels: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return q_k(x, u) and the caps c of next values, shapes (B,).

        A lower bound of E min(c, L_{k+1}(x')) is at least the level; c is inf where none is known.

        Args:
            k: control instants, int (B,).
            x: n components of the states, arrays (B,).
            u: inputs in physical units, shape (B, m).
            levels: at most q_k(x, u), shape (B,).
        """
        ...
