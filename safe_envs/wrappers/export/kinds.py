"""What values the functions of a filter have, and the types of C that hold them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Kind:
    """The kind of a value.

    Attributes:
        type: its type in C; "" for a function that returns nothing.
        size: entries of a tuple of numbers.
    """

    type: str
    size: int = 0


REAL = Kind("real")
"""A number; `real` stands for double or float."""
WHOLE = Kind("int")
TRUTH = Kind("bool")
VECTOR = Kind("vector")
"""Entries of a scratch array, to be read and written."""
TABLE = Kind("table")
"""The same with two indices."""
NUMBERS = Kind("numbers")
"""Entries that are only read: a state, an input, constants."""
FLOATS = Kind("floats")
"""A table that is only read, in single precision whatever the precision of the numbers is."""
NOTHING = Kind("")

SCALARS = (REAL, WHOLE, TRUTH)


def tuple_of(size: int) -> Kind:
    """Return the kind of a tuple of numbers, a struct with one array."""
    return Kind(f"numbers_{size}", size)


@dataclass(frozen=True)
class Struct:
    """The kind of a function's result that has parts of several kinds, a struct.

    Attributes:
        type: its type in C.
        fields: their names and kinds.
    """

    type: str
    fields: tuple[tuple[str, Kind], ...]
    size: int = 0


Result = Kind | Struct


@dataclass(frozen=True)
class Text:
    """An expression of C.

    Attributes:
        code: its text.
        kind: of its value.
        level: how tightly its operator binds, as in `LEVELS`.
    """

    code: str
    kind: Result
    level: int = 16

    def inside(self, level: int) -> str:
        """Return the text, in parentheses where its operator binds less tightly than a level."""
        return self.code if self.level >= level else f"({self.code})"


ATOM, UNARY, PRODUCT, SUM, SHIFT, ORDER, EQUAL, BITS, BOTH, EITHER, CHOICE = (
    *(16, 14, 13, 12, 11, 10),
    *(9, 8, 4, 3, 2),
)


def common(first: Result, second: Result) -> Result | None:
    """Return the kind that holds values of two kinds; None if there is none.

    Args:
        first: a kind.
        second: another one.
    """
    if first == second:
        return first
    if first in SCALARS and second in SCALARS:
        return REAL if REAL in (first, second) else WHOLE
    return None


@dataclass(frozen=True)
class CFunction:
    """A function of C.

    Attributes:
        name: its name.
        kinds: of its parameters, as its source states them.
        used: which parameters it takes; the others have no effect.
        result: kind of what it returns.
        text: its definition.
    """

    name: str
    kinds: tuple[Result, ...]
    used: tuple[bool, ...]
    result: Result
    text: str
