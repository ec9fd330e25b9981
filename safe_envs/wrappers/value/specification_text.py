"""Specifications as text, read in bounded time.

Grammar, from the loosest to the tightest, where [ ] is optional and * is any number of times:

    formula  = both ("|" both)*
    both     = until ("&" until)*
    until    = unary ["until" [window] until]
    unary    = ("always" | "eventually") [window] unary  or  sequence
    sequence = not ["then" unary]
    not      = "!" not  or  NAME  or  "(" formula ")"
    window   = "[" FIRST "," LAST "]", whole numbers of control steps

`and`, `or` and `not` may be written for the signs, which a shell may take for its own.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NoReturn

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.problem.regions import OPERATORS

_SIGNS = {"&": "and", "|": "or", "!": "not"}
_TOKEN = re.compile(r"\s*(?:([A-Za-z_][A-Za-z0-9_]*)|([0-9]+)|([&|!()\[\],]))")

_MOST_CHARACTERS = 400
_DEEPEST = 20
_LAST_STEP = 100_000
_EXAMPLE = "like 'always safe & eventually goal'"


@dataclass(frozen=True)
class Parsed:
    """A formula as it was written.

    Attributes:
        operator: one of `OPERATORS`, or "set".
        parts: operands, from left to right.
        name: of a set.
        window: first and last step from the present one; None for an unbounded operator.
    """

    operator: str
    parts: tuple[Parsed, ...] = ()
    name: str = ""
    window: tuple[int, int] | None = None

    @property
    def temporal(self) -> bool:
        """Whether the formula is about more than the present state."""
        return self.operator in ("always", "eventually", "until", "then") or any(
            part.temporal for part in self.parts
        )


def parsed(text: Any, names: Iterable[str]) -> Parsed:
    """Read a specification.

    Args:
        text: of the grammar above.
        names: of the sets that it may name.

    Raises:
        ConfigurationError: It is no such text, or names another set; with the position.
    """
    if not isinstance(text, str) or not text.strip():
        raise ConfigurationError(f"specification = {shown(text)}; give a text {_EXAMPLE}")
    if len(text) > _MOST_CHARACTERS:
        raise ConfigurationError(
            f"the specification {shown(text)} has {len(text):,} characters; give at most"
            f" {_MOST_CHARACTERS}"
        )
    return _Reader(text, tuple(names)).whole()


class _Reader:
    """Reads a text from left to right; each method one rule of the grammar."""

    def __init__(self, text: str, names: tuple[str, ...]) -> None:
        self._text, self._names = text, names
        self._tokens = list(self._split())
        self._next, self._depth = 0, 0

    def _split(self) -> Iterable[tuple[str, str, int]]:
        """Yield kind ("word", "number", "sign" or "end"), text and position of each token."""
        place = 0
        end = len(self._text.rstrip())
        while place < end:
            found = _TOKEN.match(self._text, place)
            if found is None:
                place += len(self._text[place:]) - len(self._text[place:].lstrip())
                self._refuse(
                    place, f"the character {shown(self._text[place])} has no meaning",
                    "use names, whole numbers and & | ! ( ) [ ] ,",
                )  # fmt: skip
            kind = ("word", "number", "sign")[found.lastindex - 1] if found.lastindex else ""
            written = found[found.lastindex or 0]
            yield kind, _SIGNS.get(written, written), found.start(found.lastindex or 0)
            place = found.end()
        yield "end", "the end", end

    def whole(self) -> Parsed:
        found = self._either()
        kind, written, place = self._tokens[self._next]
        if kind != "end":
            self._refuse(
                place, f"{shown(written)} follows a complete formula",
                "join formulas by &, |, until or then",
            )  # fmt: skip
        return found

    def _either(self) -> Parsed:
        return self._joined("or", self._both)

    def _both(self) -> Parsed:
        return self._joined("and", self._until)

    def _joined(self, operator: str, operand: Any) -> Parsed:
        parts = [operand()]
        while self._take(operator):
            parts.append(operand())
        return parts[0] if len(parts) == 1 else Parsed(operator, tuple(parts))

    def _until(self) -> Parsed:
        first = self._unary()
        if not self._take("until"):
            return first
        window = self._window()
        return Parsed("until", (first, self._deeper(self._until)), window=window)

    def _unary(self) -> Parsed:
        for operator in ("always", "eventually"):
            if self._take(operator):
                window = self._window()
                return Parsed(operator, (self._deeper(self._unary),), window=window)
        return self._sequence()

    def _sequence(self) -> Parsed:
        place = self._tokens[self._next][2]
        first = self._not()
        if not self._take("then"):
            return first
        if first.temporal:
            self._refuse(
                place, "what precedes 'then' is a set, or sets joined by & | !",
                "write a sequence like 'eventually (A then B then C)'",
            )  # fmt: skip
        return Parsed("then", (first, self._deeper(self._unary)))

    def _not(self) -> Parsed:
        if self._take("not"):
            return Parsed("not", (self._deeper(self._not),))
        kind, written, place = self._tokens[self._next]
        if self._take("("):
            found = self._deeper(self._either)
            self._require(")", f"it closes the one at character {place + 1}")
            return found
        if kind == "word" and written in self._names:
            self._next += 1
            return Parsed("set", name=written)
        allowed = (*self._names, "always", "eventually")
        if kind == "word" and written not in OPERATORS:
            self._refuse(place, f"{shown(written)} is no set", nearest(written, allowed))
        missing = "the text ends where a formula has to begin"
        wrong = missing if kind == "end" else f"no formula begins with {shown(written)}"
        return self._refuse(place, wrong, f"allowed: {', '.join(allowed)}, ! and (")

    def _window(self) -> tuple[int, int] | None:
        place = self._tokens[self._next][2]
        if not self._take("["):
            return None
        first = self._whole_number()
        self._require(",", "write a window like [0,50]")
        last = self._whole_number()
        self._require("]", "write a window like [0,50]")
        if not first <= last <= _LAST_STEP:
            self._refuse(
                place, f"the window is [{first},{last}]",
                f"give its first and its last control step, in order, up to {_LAST_STEP}",
            )  # fmt: skip
        return first, last

    def _whole_number(self) -> int:
        kind, written, place = self._tokens[self._next]
        if kind != "number":
            self._refuse(
                place, f"{written if kind == 'end' else shown(written)} is no control step",
                "write a window like [0,50], with whole numbers",
            )  # fmt: skip
        self._next += 1
        return int(written)

    def _deeper(self, rule: Any) -> Parsed:
        self._depth += 1
        if self._depth > _DEEPEST:
            self._refuse(
                self._tokens[self._next][2], f"formulas are nested more than {_DEEPEST} deep",
                "give a simpler one",
            )  # fmt: skip
        found = rule()
        self._depth -= 1
        return found

    def _take(self, written: str) -> bool:
        """Go past the next token if it is this one."""
        kind, present, _ = self._tokens[self._next]
        taken = kind != "end" and present == written
        self._next += taken
        return taken

    def _require(self, sign: str, why: str) -> None:
        if not self._take(sign):
            kind, written, place = self._tokens[self._next]
            given = written if kind == "end" else shown(written)
            self._refuse(place, f"{given} is given in place of {sign!r}", why)

    def _refuse(self, place: int, what: str, advice: str) -> NoReturn:
        raise ConfigurationError(
            f"specification {shown(self._text)}, at character {place + 1}: {what}; {advice}"
        )
