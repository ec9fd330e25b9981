"""The columns of a decision log: what each is of, and in which unit."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from safe_envs.errors import ConfigurationError, nearest, shown

_FLAGS = ("intervention", "feasible", "cause")
_BRACKETED_END = re.compile(r" \[([^][]*)\]$")
_HEADING = re.compile(r"(\w+):(.*?)(?: \[([^][]*)\])?", re.DOTALL)
_SECTIONS = ("state", "parameter", "nominal", "action", "low", "high", "h", "slack")


@dataclass(frozen=True)
class LogColumns:
    """Names of what a log holds, and units.

    A column is called "section:name [unit]", without the brackets where no unit is known. The
    sections are state, parameter (given at run time), nominal, action, low and high (of each
    input), h and slack (of each barrier). "t [s]" comes first; last are "intervention", "feasible"
    and "cause", the index of the barrier that caused an intervention, or -1.

    Attributes:
        states: n names.
        inputs: m names.
        barriers: k names, each once.
        parameters: names of what is given at run time.
        units: by name, as far as they are known.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    barriers: tuple[str, ...]
    parameters: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        states: Iterable[object],
        inputs: Iterable[object],
        barriers: Sequence[str],
        parameters: Iterable[object] = (),
        units: Mapping[object, str] | None = None,
    ) -> LogColumns:
        """Return the columns of symbols or names; barriers of the same name are numbered.

        In names and units characters that cannot be printed are replaced by spaces, and brackets at
        the end of a name by parentheses: there they would be read as a unit.

        Args:
            states: n symbols.
            inputs: m symbols.
            barriers: k names.
            parameters: symbols of what is given at run time.
            units: by symbol or name.

        Raises:
            ConfigurationError: The units are no mapping, or one is of nothing that is logged or
                holds a bracket; or states, inputs or parameters have a name twice.
        """
        if not isinstance(units, Mapping | None):
            raise ConfigurationError(
                f"units = {shown(units)}; give a dict of texts, such as {{'x': 'm'}}"
            )
        names = _numbered([_name(barrier) for barrier in barriers])
        parts = [tuple(map(_name, part)) for part in (states, inputs, names, parameters)]
        for part in parts:
            for name, count in Counter(part).items():
                if count > 1:
                    raise ConfigurationError(
                        f"{shown(name)} names {count} columns of the log; give each its own name"
                    )
        given = {_name(k): printable(str(unit)).strip() for k, unit in (units or {}).items()}
        given = {name: unit for name, unit in given.items() if unit}
        known = list(itertools.chain(*parts))
        for name, unit in given.items():
            if name not in known:
                raise ConfigurationError(f"units has {shown(name)}; {nearest(name, known)}")
            if "[" in unit or "]" in unit:
                raise ConfigurationError(f"the unit of {name} is {shown(unit)}; write no brackets")
        return cls(*parts, units=given)

    @cached_property
    def _names(self) -> dict[str, tuple[str, ...]]:
        """Names of what each section holds."""
        each = (self.states, self.parameters, *[self.inputs] * 4, *[self.barriers] * 2)
        return dict(zip(_SECTIONS, each, strict=True))

    @cached_property
    def sections(self) -> dict[str, slice]:
        """Where the columns of each section are."""
        widths = {"t": 1, **{name: len(of) for name, of in self._names.items()}}
        widths |= dict.fromkeys(_FLAGS, 1)
        ends = itertools.accumulate(widths.values())
        return {
            name: slice(end - width, end)
            for (name, width), end in zip(widths.items(), ends, strict=True)
        }

    @cached_property
    def headings(self) -> list[str]:
        """Return the names of all columns."""
        named = [
            f"{section}:{name}{self._bracketed(name) if section != 'slack' else ''}"
            for section, names in self._names.items()
            for name in names
        ]
        return ["t [s]", *named, *_FLAGS]

    def misfit(self, numbers: Sequence[float]) -> str | None:
        """Return why numbers cannot be those of a period; None if they can.

        Args:
            numbers: of one period.
        """
        if len(numbers) != len(self.headings):
            return f"{len(numbers)} numbers for {len(self.headings)} columns"
        *_, intervened, feasible, cause = numbers
        if not math.isfinite(numbers[0]) or not {intervened, feasible} <= {0.0, 1.0}:
            return "t must be finite, and the two flags near the end 0 or 1"
        last = len(self.barriers) - 1
        if cause not in range(-1, last + 1):
            return f"the cause at the end must be a whole number from -1 to {last}"
        return None

    def _bracketed(self, name: str) -> str:
        return f" [{self.units[name]}]" if name in self.units else ""

    @classmethod
    def read(cls, headings: Sequence[str]) -> LogColumns:
        """Read the names of columns as `headings` has them.

        Raises:
            ValueError: They are not those of a log.
        """
        twice = [heading for heading, count in Counter(headings).items() if count > 1]
        if twice:
            raise ValueError(f"it has the column {shown(twice[0])} twice")
        found: dict[str, list[str]] = {section: [] for section in _SECTIONS}
        units = {}
        for heading in headings[1 : -len(_FLAGS)]:
            parts = _HEADING.fullmatch(heading)
            if parts is None or parts[1] not in found:
                raise ValueError(f"it has the column {shown(heading)}")
            found[parts[1]].append(parts[2])
            if parts[3]:
                units[parts[2]] = parts[3]
        columns = cls(
            *(tuple(found[name]) for name in ("state", "action", "h", "parameter")), units=units
        )
        if columns.headings != list(headings) or not (columns.inputs and columns.barriers):
            raise ValueError("its columns are not those of a log, in their order")
        return columns


def printable(text: str) -> str:
    """Return a text with spaces in the place of characters that cannot be printed.

    Args:
        text: of anybody; it may hold control characters and halves of surrogate pairs.
    """
    return "".join([c if c.isprintable() else " " for c in text])


def _name(given: object) -> str:
    return _BRACKETED_END.sub(r" (\1)", printable(str(given)))


def _numbered(names: Sequence[str]) -> list[str]:
    """Return names, each once: those that come twice get numbers that no other name has."""
    count, found = Counter(names), []
    taken = {name for name in names if count[name] == 1}
    for name in names:
        if count[name] > 1:
            numbers = itertools.count(1)
            name = next(new for i in numbers if (new := f"{name} {i}") not in taken)
            taken.add(name)
        found.append(name)
    return found
