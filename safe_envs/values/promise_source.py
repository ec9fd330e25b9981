"""A promise filter as the functions and numbers of `promise_kernel`, and the tables they read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import sympy as sp

from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.slots import Data
from safe_envs.errors import ConfigurationError, NotCompilableError
from safe_envs.values import promise_kernel as layout
from safe_envs.values.grid import Grid, grid_arrays
from safe_envs.values.images import ImageWriter
from safe_envs.values.look_ahead import LookAhead, TableParts
from safe_envs.values.promise_filter import PromiseFilter
from safe_envs.values.promise_kernel import promise_decision
from safe_envs.values.reduction import KNOWN_ROUNDING

_HEAD = layout.AT_CELLS_SIZE + 1
_MOST_INPUTS = layout.IN_CHOSEN - layout.IN_TRIED


class PromiseTables(NamedTuple):
    """The tables that a promise filter reads, float32, instant by instant.

    Attributes:
        ahead: the lower envelope, smoothed.
        above: the negative upper one, smoothed.
        lower: the lower envelope.
    """

    ahead: np.ndarray
    above: np.ndarray
    lower: np.ndarray

    @property
    def memory(self) -> int:
        """Bytes of all of them."""
        return sum(each.nbytes for each in self)


class PromiseProgram(NamedTuple):
    """A promise filter as functions.

    Attributes:
        source: generated functions; `promise_promise_decision` calls them.
        data: their numbers.
        tables: that they read.
    """

    source: Source
    data: Data
    tables: PromiseTables


def promise_program(promise_filter: PromiseFilter, most_bytes: int) -> PromiseProgram:
    """Return the functions, the numbers and the tables of a promise filter.

    Args:
        promise_filter: the filter.
        most_bytes: that the tables may have.

    Raises:
        NotCompilableError: It is of a specification, has more than four inputs, or a step has an
            operation for which there is no layout.
        ConfigurationError: The tables are larger.
    """
    ahead = promise_filter.look_ahead
    if not isinstance(ahead, LookAhead):
        raise NotCompilableError(
            f"{promise_filter.text} keeps a specification, which has no form in C yet; export a"
            " promise of staying safe"
        )
    parts = ahead.parts
    if len(promise_filter.problem.input_bounds) > _MOST_INPUTS:
        raise NotCompilableError(
            f"{promise_filter.problem.name} has more than {_MOST_INPUTS} inputs, for which a"
            " promise has no form in C"
        )
    _require_small(promise_filter.text, parts, most_bytes)
    tables = PromiseTables(parts.bounds.smoothed(1), parts.bounds.smoothed(-1), parts.table.lower)
    writer = _Writer(promise_filter, ahead, parts)
    return PromiseProgram(writer.source(), writer.data, tables)


def _require_small(text: str, parts: TableParts, most_bytes: int) -> None:
    instants, cells = parts.table.lower.shape
    size = 4 * instants * (cells + 2 * parts.bounds.grid.cells)
    if size <= most_bytes:
        return
    shape = parts.table.grid.shape
    share = (most_bytes / size) ** (1.0 / len(shape))
    fewer = "x".join(str(int(0.95 * share * count)) for count in shape)
    raise ConfigurationError(
        f"the tables of {text} are of {size / 2**20:.0f} MB, and an export takes at most"
        f" {most_bytes / 2**20:.0f} MB: they hold {instants} instants of"
        f" {'x'.join(map(str, shape))} cells. Compute one with fewer cells, about {fewer}"
        " (safe-envs best ENV --cells ... --table FILE), and export the filter with :table=FILE"
    )


class _Data(Data):
    """Numbers of which those in front are set last."""

    def __init__(self) -> None:
        super().__init__()
        self.add([0.0] * _HEAD)

    def put(self, place: int, value: float) -> None:
        """Set one of the numbers in front."""
        self._values[place] = float(value)


class _Writer:
    """Writes the generated functions of one filter."""

    def __init__(self, promise_filter: PromiseFilter, ahead: LookAhead, parts: TableParts) -> None:
        self._filter, self._ahead, self._parts, self.data = promise_filter, ahead, parts, _Data()
        step, reduced = parts.step, parts.reduced
        self._n, self._m = len(reduced.coordinates), len(reduced.inputs)
        self._boxes, self._scenarios = len(step.noise.weights), step.scenarios
        self._images = layout.IN_ARRAYS + self._boxes + len(ahead.inputs)
        self._effects = self._images + self._scenarios * self._boxes * self._n * 2
        self._work = self._effects + self._scenarios * self._n * self._m * 2
        self._fill()

    def _fill(self) -> None:
        data, parts, coarse = self.data, self._parts, self._filter.coarse
        arrays = {
            layout.AT_WEIGHTS: parts.step.noise.weights,
            layout.AT_SCANNED_INPUTS: self._ahead.inputs.ravel(),
            layout.AT_COARSE_INPUTS: coarse.ravel(),
            layout.AT_BOUNDS: np.array(self._filter.problem.input_bounds).ravel(),
        }
        numbers = {
            layout.AT_COORDINATES: self._n,
            layout.AT_INPUTS: self._m,
            layout.AT_SCENARIOS: self._scenarios,
            layout.AT_BOXES: self._boxes,
            layout.AT_SCANNED: len(self._ahead.inputs),
            layout.AT_COARSE: len(coarse),
            layout.AT_STEPS: self._ahead.steps,
            layout.AT_FIRST: parts.table.first,
            layout.AT_PROBABILITY: self._filter.settings.probability,
            layout.AT_REST: parts.bounds.rest,
            layout.AT_COARSE_SPACING: self._filter.coarse_spacing,
            layout.AT_SPACING: self._filter.spacing,
            layout.AT_SEES_VALUES: parts.bounds.sees_values,
            layout.AT_IS_AFFINE: parts.step.is_affine,
            layout.AT_MEANS_SIZE: parts.bounds.grid.cells,
            layout.AT_CELLS_SIZE: parts.table.grid.cells,
            layout.AT_MEANS: self._add_grid(parts.bounds.grid, parts.bounds.slack),
            layout.AT_CELLS: self._add_grid(parts.table.grid, 0.0),
        }
        for place, values in arrays.items():
            numbers[place] = data.add(values.tolist())
        for place, number in numbers.items():
            data.put(place, number)

    def _add_grid(self, grid: Grid, slack: float) -> int:
        """Add a grid, and return the place of its axes."""
        data, found = self.data, grid_arrays(grid, slack)
        edges, places = data.add(found.edges), data.add(found.places)
        counts, numbers = found.counts.reshape(5, -1), []
        for i in range(len(grid.axes)):
            count, edge, place, size = counts[:4, i].tolist()
            numbers += [count, edges + edge, places + place, size, *found.scales[i]]
        return data.add(numbers)

    def source(self) -> Source:
        """Return the generated functions, with all that they call."""
        data, reduced, plant = self.data, self._parts.reduced, self._filter.problem.plant
        barriers = [plant.numeric(b.expression) for b in self._filter.problem.barriers]
        expressions = [c.expression for c in reduced.coordinates]
        source = formulas("promise_coordinates", {"x": plant.states}, expressions, data)
        source += formulas("promise_barriers", {"x": plant.states}, barriers, data)
        source += self._point() + self._sets(len(barriers)) + self._assumed() + self._image()
        return Source(source.text, (*source.uses, promise_decision), self._work)

    def _point(self) -> Source:
        lines = ["def promise_point(x, data, work):", "    point = promise_coordinates(x, data)"]
        for i, axis in enumerate(self._parts.table.grid.axes):
            value = f"point[{i}]"
            if axis.period:
                low, high = float(axis.edges[0]), float(axis.edges[-1])
                below = float(np.nextafter(high, low))
                turns = f"floor(({value} - {low!r}) / {axis.period!r})"
                value = f"min(max({value} - {axis.period!r} * {turns}, {low!r}), {below!r})"
            lines.append(f"    work[{layout.IN_POINT + i}] = {value}")
        return Source("\n".join(lines) + "\n")

    def _sets(self, barriers: int) -> Source:
        reduced = self._parts.reduced
        source = Source(
            "def promise_has_barriers(x, data):\n"
            "    barriers = promise_barriers(x, data)\n"
            "    return " + " and ".join(f"barriers[{i}] > 0.0" for i in range(barriers)) + "\n"
        )
        lines, safe = ["def promise_is_safe(x, k, data, work):"], "promise_has_barriers(x, data)"
        if self._parts.leaving == "violation" and reduced.outside.free_symbols:
            symbols = (*reduced.symbols, *reduced.known)
            source += formulas("promise_outside", {"q": symbols}, [reduced.outside], self.data)
            entries = [f"work[{layout.IN_POINT + i}]" for i in range(self._n)]
            entries += [f"data[{self.data.add(v)} + k]" for v in reduced.known.values()]
            lines.append(f"    q = ({''.join(f'{each}, ' for each in entries)})")
            lines.append("    outside = promise_outside(q, data)")
            safe += " and outside[0] <= 0.0"
        return source + Source("\n".join([*lines, f"    return {safe}"]) + "\n")

    def _assumed(self) -> Source:
        tests = []
        for i, values in self._parts.reduced.assumed.items():
            expected = f"data[{self.data.add(values)} + k]"
            tests.append(
                f"abs(x[{i}] - {expected}) <= {KNOWN_ROUNDING!r} * (1.0 + abs({expected}))"
            )
        test = " and ".join(tests) or "True"
        return Source(f"def promise_is_assumed(x, k, data):\n    return {test}\n")

    def _image(self) -> Source:
        """Return `promise_images`."""
        reduced, parts, noise = self._parts.reduced, self._parts.step.parts, self._parts.step.noise
        rest, effect = parts.rest, parts.effect
        used = set().union(*(e.free_symbols for e in (*rest, *(e for row in effect for e in row))))
        add, size = self.data.add, len(reduced.intervals)
        worlds = add(self._parts.step.worlds.ravel())
        low, high = add(noise.low.ravel()), add(noise.high.ravel())
        codes: dict[sp.Symbol, tuple[int, str]] = {}
        for i, symbol in enumerate(reduced.symbols):
            codes[symbol] = 0, _twice(f"work[{layout.IN_POINT + i}]")
        for symbol, values in reduced.known.items():
            codes[symbol] = 0, _twice(f"data[{add(values)} + k]")
        for i, symbol in enumerate(reduced.intervals):
            place = f"{worlds} + (r * {size} + {i}) * 2"
            codes[symbol] = 1, f"(data[{place}], data[{place} + 1])"
        for j, symbol in enumerate(reduced.inputs):
            codes[symbol] = 2, _twice(f"work[{layout.IN_TRIED + j}]")
        for c, symbol in enumerate(parts.boxed):
            place = f"{c * self._boxes} + w"
            codes[symbol] = 3, f"(data[{low} + {place}], data[{high} + {place}])"
        writer = ImageWriter({s: code for s, code in codes.items() if s in used})
        moved = [writer.value(e)[1] for e in rest]
        effects = [[writer.value(e)[1] for e in row] for row in effect]
        return Source(self._image_text(writer, moved, effects), tuple(writer.uses))

    def _image_text(
        self, writer: ImageWriter, moved: Sequence[str], effects: Sequence[Sequence[str]]
    ) -> str:
        n, m, lines = self._n, self._m, writer.lines
        ends = [lines[0], lines[1], lines[2], lines[3]]
        for i, row in enumerate(effects):
            for j, name in enumerate(row):
                place = f"{self._effects} + ((r * {n} + {i}) * {m} + {j}) * 2"
                # An infinite effect of an input that is 0 would be no number.
                ends[1].append(f"work[{place}] = max({name}[0], -1e200)")
                ends[1].append(f"work[{place} + 1] = min({name}[1], 1e200)")
        for i, name in enumerate(moved):
            place = f"{self._images} + ((r * {self._boxes} + w) * {n} + {i}) * 2"
            ends[3] += [f"work[{place}] = {name}[0]", f"work[{place} + 1] = {name}[1]"]
        code = ["def promise_images(k, data, work):", *(f"    {line}" for line in ends[0])]
        code += [f"    for r in range({self._scenarios}):"]
        code += [f"        {line}" for line in (*ends[1], *ends[2])]
        code += [f"        for w in range({self._boxes}):"]
        return "\n".join([*code, *(f"            {line}" for line in ends[3])]) + "\n"


def _twice(code: str) -> str:
    return f"({code}, {code})"
