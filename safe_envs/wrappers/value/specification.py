"""Temporal specifications over named sets, on finite traces, and how robustly a trace meets them.

A trace is the states x_0, ..., x_N of an episode at its control instants; N = K unless the episode
ends before. With values m_s(x) of the sets s (h of `safe`, and so on), the robustness r(f, k) of a
formula f at instant k <= N is

    set s             m_s(x_k)
    ! f               -r(f, k)
    f & g,  f | g     min, max of r(f, k) and r(g, k)
    eventually[a,b] f max of r(f, j) over j in [k + a, k + b], j <= N
    always[a,b] f     min of r(f, j) over these j
    f until[a,b] g    max over these j of min(r(g, j), min of r(f, i) over k <= i < j)
    f then g          min(r(f, k), r(eventually g, k))

with b = N without a window; a maximum over nothing is -inf, a minimum inf. The trace satisfies the
specification if the same holds with truth values, where x_k is in a set. So r > 0 implies that it
does, r < 0 that it does not, and if all set values move by less than |r|, that stays so.

What the rest of a trace can change is known by finitely many numbers. Let v be the robustness at
the next instant of the subformulas with a temporal operator, of which there are n. Each obeys a
one-step identity, such as

    r(f until g, k) = max(r(g, k), min(r(f, k), r(f until g, k + 1))),

so that r(specification, 0) = R_k(v) with a function R_k of minima and maxima of the v_i and of
numbers that x_0, ..., x_k give. Such a function obeys

    R(v) = max(R(v with v_i = -inf), min(v_i, R(v with v_i = inf)))       for each i,

for it is monotone and lattice operations distribute. So it is determined by its values at the 2^n
vertices, v_i = +-inf; these are the *registers*. Negations stand before sets only: the dual of
`until` is an operator of its own, which makes R_k monotone. Past the end of a trace an `until` has
v = -inf and its dual v = inf, which is one vertex: its register is the robustness of the trace so
far. Registers of +-inf are the truth values, and the states of a deterministic automaton; see
`safe_envs.wrappers.value.automaton`.

Source: A. Donze, O. Maler, Robust satisfaction of temporal logic over real-valued signals, FORMATS
    2010 (robustness); G. De Giacomo, M. Vardi, Linear temporal logic and linear dynamic logic on
    finite traces, IJCAI 2013 (finite traces); F. Bacchus, F. Kabanza, Using temporal logics to
    express search control knowledge for planning, Artificial Intelligence 116, 2000 (progression);
    R. L. Goodstein, The solution of equations in a lattice, Proc. Royal Society of Edinburgh A 67,
    1967 (lattice polynomials are determined by their values at the vertices).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError, shown
from safe_envs.wrappers.value.specification_text import Parsed, parsed

_MOST_SUBFORMULAS = 6
_DUAL = {"and": "or", "or": "and", "until": "release", "release": "until", "set": "not in set"}


@dataclass(frozen=True)
class Formula:
    """A formula with negations before sets only.

    Attributes:
        kind: "set", "not in set", "and", "or", "until" or "release", its dual.
        parts: of "and" and "or"; of "until" and "release" g and, unless it is true (false), f.
        name: of the set.
        first: of the window, in control steps.
        last: of the window; None for no end.
        clocked: whether the window is counted from the start of the episode, not from the instant
            at which the formula is evaluated.
    """

    kind: str
    parts: tuple[Formula, ...] = ()
    name: str = ""
    first: int = 0
    last: int | None = None
    clocked: bool = False

    @property
    def following(self) -> Formula | None:
        """What has to hold at the next instant, where the present one does not decide."""
        if self.clocked or (self.first, self.last) == (0, None):
            return self
        if self.last == 0:
            return None
        last = None if self.last is None else self.last - 1
        return replace(self, first=max(self.first - 1, 0), last=last)


class Specification:
    """A temporal specification over named sets.

    Attributes:
        text: as given.
        atoms: names of the sets that occur, in the order of the given names.
        formula: of the whole.
        clocks: first instants, in order, at which a window of the whole opens or has closed.
        last_instant: the last one of these windows; 0 without any.

    Args:
        text: see `safe_envs.wrappers.value.specification_text`.
        names: of the sets that the problem has.

    Raises:
        ConfigurationError: The text is no specification over these sets, or has too many parts.
    """

    def __init__(self, text: str, names: Iterable[str]) -> None:
        known = tuple(names)
        self.text = text
        self.formula = _formula(parsed(text, known), negated=False, outermost=True)
        occurring = {f.name for f in _parts_of(self.formula) if f.name}
        self.atoms = tuple(name for name in known if name in occurring)
        self._pending = self._subformulas()
        self.size = 1 << len(self._pending)
        bits = np.arange(self.size) >> np.arange(len(self._pending))[:, None] & 1
        self._vertices = np.where(bits, np.inf, -np.inf)
        self._end = sum(1 << i for i, f in enumerate(self._pending) if f.kind == "release")
        clocked = [f for f in _parts_of(self.formula) if f.clocked and f.last is not None]
        ends = {f.first for f in clocked} | {(f.last or 0) + 1 for f in clocked}
        self.clocks = tuple(sorted(ends - {0}))
        self.last_instant = max((f.last or 0 for f in clocked), default=0)

    def start(self, values: np.ndarray) -> np.ndarray:
        """Return the registers after the first state of a trace.

        Args:
            values: of the sets at x_0, positive inside, shape (number of atoms, B).

        Returns:
            Shape (size, B).
        """
        found = self._evaluated(self.formula, 0, values[:, None], self._rest())
        return np.broadcast_to(found, (self.size, values.shape[1])).copy()

    def advance(self, k: Any, registers: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the registers after one more state.

        Args:
            k: control instant of that state, at least 1; an int, or an array (B,).
            registers: after instant k - 1, shape (size, B) or (size, 1).
            values: of the sets at x_k, shape (number of atoms, B).

        Returns:
            Shape (size, B).
        """
        rest, at, width = self._rest(), values[:, None], values.shape[1]
        found = np.broadcast_to(registers, (self.size, width))[:, None]
        for f in reversed(self._pending):
            now = self._evaluated(f, k, at, rest)
            half = len(found) // 2
            found = np.maximum(found[:half], np.minimum(now, found[half:]))
        return np.broadcast_to(found[0], (self.size, width)).copy()

    def robustness(self, registers: np.ndarray) -> np.ndarray:
        """Return the robustness, shape (B,), of the traces so far."""
        return registers[self._end]

    def robustness_of(self, trace: np.ndarray) -> np.ndarray:
        """Return the robustness, shape (B,), of whole traces.

        Args:
            trace: values of the sets, shape (N + 1, number of atoms, B).
        """
        registers = self.start(trace[0])
        for k in range(1, len(trace)):
            registers = self.advance(k, registers, trace[k])
        return self.robustness(registers)

    def require_horizon(self, steps: int) -> None:
        """Check that every window closes within an episode.

        Args:
            steps: control periods of an episode.

        Raises:
            ConfigurationError: One does not.
        """
        if self.last_instant > steps:
            raise ConfigurationError(
                f"specification {shown(self.text)}: a window ends at step {self.last_instant}, and"
                f" an episode has {steps} steps; shorten the window or lengthen the horizon"
            )

    def _rest(self) -> Mapping[Formula, np.ndarray]:
        """Return the robustness of the pending subformulas at the next instant, at each vertex."""
        return {f: self._vertices[i][:, None] for i, f in enumerate(self._pending)}

    def _evaluated(
        self, f: Formula, k: Any, values: np.ndarray, rest: Mapping[Formula, np.ndarray]
    ) -> Any:
        """Return the robustness of a formula at instant k, given that of `rest` at the next."""
        if f.kind == "set":
            return values[self.atoms.index(f.name)]
        if f.kind == "not in set":
            return -values[self.atoms.index(f.name)]
        parts = [self._evaluated(part, k, values, rest) for part in f.parts]
        grow, shrink = np.maximum, np.minimum
        if f.kind in ("and", "release"):
            grow, shrink = shrink, grow
        if f.kind in ("and", "or"):
            return grow.reduce(np.broadcast_arrays(*parts))
        closed = np.float64(np.inf if f.kind == "release" else -np.inf)
        now = parts[0]
        if f.clocked and f.last is not None:
            now = np.where((f.first <= k) & (k <= f.last), now, closed)
        elif f.first > 0:
            now = closed
        later = closed if f.following is None else rest[f.following]
        return grow(now, later if len(parts) == 1 else shrink(parts[1], later))

    def _subformulas(self) -> tuple[Formula, ...]:
        """Return the temporal subformulas, and what their windows become.

        Raises:
            ConfigurationError: There are too many.
        """
        found: dict[Formula, None] = {}
        for part in _parts_of(self.formula):
            pending = part.following if part.kind in ("until", "release") else None
            while pending is not None and pending not in found:
                found[pending] = None
                if len(found) > _MOST_SUBFORMULAS:
                    raise ConfigurationError(
                        f"specification {shown(self.text)} has more than {_MOST_SUBFORMULAS}"
                        " temporal operators, where a window within another operator counts as"
                        " many as it has steps; give fewer, or windows outside of all other"
                        " operators, which count once"
                    )
                pending = pending.following
        return tuple(found)


def _formula(given: Parsed, *, negated: bool, outermost: bool) -> Formula:
    """Return a formula or its negation.

    Args:
        given: as written.
        negated: whether to negate it.
        outermost: whether it is evaluated at the start of the episode.
    """

    def part(i: int, outermost: bool = False) -> Formula:
        return _formula(given.parts[i], negated=negated, outermost=outermost)

    def kind(name: str) -> str:
        return _DUAL[name] if negated else name

    if given.operator == "set":
        return Formula(kind("set"), name=given.name)
    if given.operator == "not":
        return _formula(given.parts[0], negated=not negated, outermost=outermost)
    if given.operator in ("and", "or"):
        parts = tuple(part(i, outermost) for i in range(len(given.parts)))
        return Formula(kind(given.operator), parts)
    if given.operator == "then":
        later = Formula(kind("until"), (part(1),))
        return Formula(kind("and"), (part(0), later))
    clocked = outermost and given.window is not None
    first, last = given.window or (0, None)
    operator = "release" if given.operator == "always" else "until"
    parts = (part(1), part(0)) if given.operator == "until" else (part(0),)
    return Formula(kind(operator), parts, "", first, last, clocked)


def _parts_of(formula: Formula) -> Iterator[Formula]:
    """Yield a formula and all its parts, the outer ones first."""
    yield formula
    for part in formula.parts:
        yield from _parts_of(part)
