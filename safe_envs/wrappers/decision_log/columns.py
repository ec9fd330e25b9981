"""The columns of a decision log: what each is of, and in which unit."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from safe_envs.errors import ConfigurationError, nearest, shown

_FLAGS = ("intervention", "feasible", "cause")
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

        Args:
            states: n symbols.
            inputs: m symbols.
            barriers: k names.
            parameters: symbols of what is given at run time.
            units: by symbol or name.

        Raises:
            ConfigurationError: The units are no mapping, or one is of nothing that is logged or
                holds a bracket.
        """
        if not isinstance(units, Mapping | None):
            raise ConfigurationError(
                f"units = {shown(units)}; give a dict of texts, such as {{'x': 'm'}}"
            )
        count, number = Counter(barriers), Counter()
        names = []
        for name in barriers:
            number[name] += 1
            names.append(f"{name} {number[name]}" if count[name] > 1 else name)
        parts = [tuple(map(str, part)) for part in (states, inputs, names, parameters)]
        given = {str(name): str(unit) for name, unit in (units or {}).items() if unit}
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

    def _bracketed(self, name: str) -> str:
        return f" [{self.units[name]}]" if name in self.units else ""

    @classmethod
    def read(cls, headings: Sequence[str]) -> LogColumns:
        """Read the names of columns as `headings` has them.

        Raises:
            ValueError: They are not those of a log.
        """
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
