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
`safe_envs.filters.specification`.

Source: A. Donze, O. Maler, Robust satisfaction of temporal logic over real-valued signals, FORMATS
    2010 (robustness); G. De Giacomo, M. Vardi, Linear temporal logic and linear dynamic logic on
    finite traces, IJCAI 2013 (finite traces); F. Bacchus, F. Kabanza, Using temporal logics to
    express search control knowledge for planning, Artificial Intelligence 116, 2000 (progression);
    R. L. Goodstein, The solution of equations in a lattice, Proc. Royal Society of Edinburgh A 67,
    1967 (lattice polynomials are determined by their values at the vertices).

Grammar, from the loosest to the tightest, where [ ] is optional and * is any number of times:

    formula  = both ("|" both)*
    both     = until ("&" until)*
    until    = unary ["until" [window] until]
    unary    = ("always" | "eventually") [window] unary  or  sequence
    sequence = not ["then" unary]
    not      = "!" not  or  NAME  or  "(" formula ")"
    window   = "[" FIRST "," LAST "]", whole numbers of control steps

`and`, `or` and `not` may be written for the signs, which a shell may take for its own.

`safe_envs.filters.specification` makes them of specifications.

*Use in a dynamic program.* Let the episode have the states x_0, ..., x_K, the label l(x) be the
sets in which x is, and a_k = delta_k(a_{k-1}, l(x_k)), a_{-1} the initial state. Then (x_k, a_k) is
a controlled Markov process, since a_k is a function of x_0, ..., x_k, and the trace satisfies the
specification iff a_N accepts for its last instant N. So

    V_K(x, a) = V_k(x, a) = 1{a accepts} where the episode has ended, at the goal or outside,
    V_k(x, a) = max_u E V_{k+1}(F(x, u, xi), delta_{k+1}(a, l(F(x, u, xi))))         elsewhere

is the largest probability of satisfaction from there, by backward induction over that process, for
policies that may remember everything too: given (x_k, a_k) nothing else of the past changes the law
of what follows or what is accepted. Where the verdict on (k, a) is known, V_k is 1 or 0 at every x.
From the start it is V_0(x_0, delta_0(a_{-1}, l(x_0))). "always safe" has two states, of which one
has V = 0, and its V is that of safety.

The states are the truth values of the registers of `Specification`: what is to be known of the
labels so far. They are those that occur, each instant by itself, since windows that are counted
from the start make the transitions depend on time; states with the same future are one state.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NoReturn

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.envs.info import Info, specification_info
from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.problem.named_sets import NamedSets, set_expressions, set_names
from safe_envs.problem.problem import SafetyProblem
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
        text: see `safe_envs.filters.specification`.
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
        """Return the temporal subformulas, and what their windows become."""
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
    """Return a formula or its negation."""

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


@dataclass(frozen=True, eq=False)
class Automaton:
    """A deterministic automaton whose transitions may depend on the control instant.

    Attributes:
        atoms: names of the sets; set i is bit i of a label.
        initial: state before the first label.
        begins: first control instant of each phase, in order from 0, shape (P,).
        transitions: next state by phase, state and label, shape (P, S, 2^atoms).
        accepting: whether a trace that ends in this state satisfies the specification, (S,).
        verdicts: after the label of an instant of the phase: 1 where every continuation and end
            satisfies the specification, -1 where none does, 0 where that is open, shape (P, S).
    """

    atoms: tuple[str, ...]
    initial: int
    begins: np.ndarray
    transitions: np.ndarray
    accepting: np.ndarray
    verdicts: np.ndarray

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self.accepting)

    def label(self, inside: Sequence[Any]) -> Any:
        """Return the label of states, as int or array of them.

        Args:
            inside: for each atom whether the state is in it: bool, or an array of any shape.
        """
        return sum(np.asarray(each, dtype=np.int64) << i for i, each in enumerate(inside))

    def phase(self, k: Any) -> Any:
        """Return the phase of control instants, an int or an array of them."""
        return np.searchsorted(self.begins, k, side="right") - 1

    def step(self, k: Any, state: Any, label: Any) -> np.ndarray:
        """Return the state after the label of instant k; arguments broadcast.

        Args:
            k: control instant.
            state: after instant k - 1; `initial` for k = 0.
            label: of the state of the system at instant k.
        """
        return self.transitions[self.phase(k), state, label]

    def verdict(self, k: Any, state: Any) -> np.ndarray:
        """Return what is known after instant k: 1, -1 or 0, see `verdicts`."""
        return self.verdicts[self.phase(k), state]

    def run(self, labels: Sequence[Any]) -> np.ndarray:
        """Return the state after a trace of labels, each an int or an array of one shape."""
        state: Any = np.full(np.shape(labels[0]), self.initial)
        for k, label in enumerate(labels):
            state = self.step(k, state, label)
        return state


MOST_STATES = 8

_MOST_RAW_STATES = 400
_MOST_ATOMS = 6

_Successors = Mapping[int, tuple[int, ...]]
"""Successor of a state under each label."""


def automaton_of(specification: Specification) -> Automaton:
    """Return the automaton of a specification.

    Raises:
        ConfigurationError: It needs more than `MOST_STATES` states.
    """
    if len(specification.atoms) > _MOST_ATOMS:
        raise ConfigurationError(
            f"specification {shown(specification.text)} names {len(specification.atoms)} sets; give"
            f" at most {_MOST_ATOMS}"
        )
    unfolding = _Unfolding(specification)
    return _Reduction(unfolding).automaton(specification)


def problem_automaton(problem: SafetyProblem, text: str) -> Automaton:
    """Return the automaton of a specification over the sets of a problem.

    Args:
        problem: which has the sets.
        text: of the specification.

    Raises:
        ConfigurationError: The text is no specification over these sets, needs too many states, or
            has a window that ends after the episode.
    """
    specification = Specification(text, set_names(problem))
    specification.require_horizon(problem.steps)
    for name in specification.atoms:
        set_expressions(problem, name)
    return automaton_of(specification)


class _Unfolding:
    """The truth values of registers that occur at each instant.

    Attributes:
        tail: first instant from which on transitions do not depend on time, at least 1.
        occurring: for each instant 1..tail the states before its label; of the tail, all that
            follow too. The entry of instant 0 is empty.
        successors: for each such instant the transitions.
        first: state after each label of instant 0.
        accepting: whether the trace may end in this state.
    """

    def __init__(self, specification: Specification) -> None:
        self._specification = specification
        bits = np.arange(1 << len(specification.atoms))
        inside = bits >> np.arange(len(specification.atoms))[:, None] & 1
        self._values = np.where(inside, np.inf, -np.inf)
        self._numbers: dict[bytes, int] = {}
        self._registers: list[np.ndarray] = []
        self.accepting: list[bool] = []
        self.first = self._known(specification.start(self._values))
        self.tail = max((1, *specification.clocks))
        self.occurring: list[frozenset[int]] = [frozenset(), frozenset(self.first)]
        self.successors: list[_Successors] = [{}]
        patterns: dict[tuple[int, int], tuple[int, ...]] = {}
        for k in range(1, self.tail):
            here, clock = self.occurring[k], self._clock(k)
            if self._clock(k - 1) == clock and k > 1 and here == self.occurring[k - 1]:
                successors = self.successors[k - 1]
            else:
                successors = {a: self._row(k, a, (clock, a), patterns) for a in sorted(here)}
            self.successors.append(successors)
            following = frozenset(b for row in successors.values() for b in row)
            self.occurring.append(here if following == here else following)
        clock, left, last = self._clock(self.tail), sorted(self.occurring[-1]), {}
        while left:
            a = left.pop(0)
            last[a] = self._row(self.tail, a, (clock, a), patterns)
            left += sorted(set(last[a]) - set(last) - set(left))
        self.occurring[-1] = frozenset(last)
        self.successors.append(last)

    def _clock(self, k: int) -> int:
        """Return how many windows have opened or closed by instant k."""
        return int(np.searchsorted(self._specification.clocks, k, side="right"))

    def _row(
        self, k: int, a: int, key: tuple[int, int], made: dict[tuple[int, int], tuple[int, ...]]
    ) -> tuple[int, ...]:
        if key not in made:
            registers = self._registers[a][:, None]
            made[key] = self._known(self._specification.advance(k, registers, self._values))
        return made[key]

    def _known(self, registers: np.ndarray) -> tuple[int, ...]:
        """Return the numbers of states, given by their registers in columns."""
        found = []
        for column in registers.T:
            number = self._numbers.setdefault((column > 0).tobytes(), len(self._numbers))
            if number == len(self._registers):
                self._registers.append(column.copy())
                self.accepting.append(bool(self._specification.robustness(column) > 0))
            found.append(number)
        if len(self._registers) > _MOST_RAW_STATES:
            raise _too_large(self._specification, f"more than {MOST_STATES}")
        return tuple(found)


class _Reduction:
    """States with the same future are one state, at each instant by itself."""

    def __init__(self, unfolding: _Unfolding) -> None:
        self._u = unfolding
        tail = unfolding.tail
        # By instant before whose label they hold: the representative and the verdict of a state.
        self.representative: list[dict[int, int]] = [{}] * (tail + 1)
        self.verdict: list[dict[int, int]] = [{}] * (tail + 1)
        self.representative[tail] = self._stationary()
        self.verdict[tail] = self._settled()
        for k in range(tail - 1, 0, -1):
            if k + 2 <= tail and (
                unfolding.successors[k] is unfolding.successors[k + 1]
                and self.representative[k + 1] is self.representative[k + 2]
                and self.verdict[k + 1] is self.verdict[k + 2]
            ):
                self.representative[k], self.verdict[k] = (
                    self.representative[k + 1],
                    self.verdict[k + 1],
                )
                continue
            self._join(k)

    def automaton(self, specification: Specification) -> Automaton:
        """Return the reduced automaton; raises as `automaton_of`."""
        u = self._u
        used = sorted({a for found in self.representative for a in found.values()})
        if len(used) > MOST_STATES:
            raise _too_large(specification, str(len(used)))
        number = {a: i for i, a in enumerate(used)}
        table = np.zeros((len(used), len(u.first)), dtype=np.int64)
        verdict = np.zeros(len(used), dtype=np.int64)
        tables: list[tuple[int, np.ndarray, np.ndarray]] = []
        for k in range(u.tail, 0, -1):
            # Instants without a state keep what later ones have: fewer phases.
            after = min(k + 1, u.tail)
            same = k < u.tail - 1 and (
                u.successors[k] is u.successors[k + 1]
                and self.representative[k] is self.representative[k + 1]
                and self.representative[k + 1] is self.representative[k + 2]
                and self.verdict[k + 1] is self.verdict[k + 2]
            )
            if not same:
                table, verdict = table.copy(), verdict.copy()
                for a, row in u.successors[k].items():
                    table[number[self.representative[k][a]]] = [
                        number[self.representative[after][b]] for b in row
                    ]
                for a, known in self.verdict[after].items():
                    verdict[number[self.representative[after][a]]] = known
            tables.append((k, table, verdict))
        first = np.array([number[self.representative[1][b]] for b in u.first])
        initial, opening = _begun(first, table)
        known = verdict.copy()
        for a, settled in self.verdict[1].items():
            known[number[self.representative[1][a]]] = settled
        tables.append((0, opening, known))
        begins = [tables.pop()]
        for each in reversed(tables):
            if any((x != y).any() for x, y in zip(each[1:], begins[-1][1:], strict=True)):
                begins.append(each)
        return Automaton(
            specification.atoms,
            initial,
            np.array([k for k, _, _ in begins]),
            np.array([each for _, each, _ in begins]),
            np.array([u.accepting[a] for a in used]),
            np.array([each for _, _, each in begins]),
        )

    def _join(self, k: int) -> None:
        """Find which states before instant k have the same future, from those after it."""
        u, later = self._u, self.representative[k + 1]
        found: dict[Any, int] = {}
        representative, verdict = {}, {}
        for a in sorted(u.occurring[k]):
            row = u.successors[k][a]
            key = (u.accepting[a], *(later[b] for b in row))
            representative[a] = found.setdefault(key, a)
            verdict[a] = _common(u.accepting[a], [self.verdict[k + 1][b] for b in row])
        # One object for what stays the same over a long window.
        if representative == later:
            representative = later
        if verdict == self.verdict[k + 1]:
            verdict = self.verdict[k + 1]
        self.representative[k], self.verdict[k] = representative, verdict

    def _stationary(self) -> dict[int, int]:
        """Return the representatives of the states of the tail, by refining a partition."""
        u, successors = self._u, self._u.successors[-1]
        block: dict[int, Any] = {a: u.accepting[a] for a in successors}
        count = 0
        while len(set(block.values())) > count:
            count = len(set(block.values()))
            keys = {a: (block[a], *(block[b] for b in row)) for a, row in successors.items()}
            numbers = {key: i for i, key in enumerate(dict.fromkeys(keys.values()))}
            block = {a: numbers[key] for a, key in keys.items()}
        found: dict[Any, int] = {}
        return {a: found.setdefault(block[a], a) for a in sorted(successors)}

    def _settled(self) -> dict[int, int]:
        """Return the verdicts on the states of the tail: a verdict falls where a way leads out."""
        u, successors = self._u, self._u.successors[-1]
        verdict = {a: 1 if u.accepting[a] else -1 for a in successors}
        while True:
            fallen = {
                a: _common(u.accepting[a], [verdict[b] for b in successors[a]]) for a in successors
            }
            if fallen == verdict:
                return verdict
            verdict = fallen


def _common(accepting: bool, following: Sequence[int]) -> int:
    """Return the verdict that an end here and all continuations share; 0 without one."""
    here = 1 if accepting else -1
    return here if all(each == here for each in following) else 0


def _begun(first: np.ndarray, table: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the initial state and the transitions of instant 0."""
    # Only the initial state has any then, so that it can be one that has these later, or else any.
    for a, row in enumerate(table):
        if (row == first).all():
            return a, table
    opening = table.copy()
    opening[0] = first
    return 0, opening


def _too_large(specification: Specification, count: str) -> ConfigurationError:
    return ConfigurationError(
        f"specification {shown(specification.text)} needs an automaton of {count} states; at most"
        f" {MOST_STATES} are allowed: give fewer sets in sequence, or windows outside of all other"
        " operators, which need no states of their own"
    )


class SpecificationTracker:
    """Follows the automaton and the robustness of a specification, episode by episode.

    Attributes:
        specification: over the problem's sets.
        automaton: of it.
        steps: control periods of each episode so far, (B,).
        states: of the automaton, (B,).
        registers: of the specification, (size, B).

    Args:
        problem: whose sets the specification names.
        text: of the specification.
        count: B, the number of episodes.

    Raises:
        ConfigurationError: The text is no specification over the problem's sets, needs too many
            states, or has a window that ends after the episode.
    """

    def __init__(self, problem: SafetyProblem, text: str, count: int) -> None:
        self.specification = Specification(text, set_names(problem))
        self.specification.require_horizon(problem.steps)
        self.automaton = automaton_of(self.specification)
        self._sets = NamedSets(problem, self.specification.atoms)
        self._bits = 1 << np.arange(len(self.specification.atoms))
        self.steps = np.zeros(count, dtype=np.int64)
        self.states = np.full(count, self.automaton.initial)
        self.registers = np.zeros((self.specification.size, count))

    def begin(self, x: Components, envs: np.ndarray) -> None:
        """Begin traces.

        Args:
            x: components of all states, each (B,).
            envs: which traces begin, bool (B,).

        Raises:
            NumericalError: A set has no value there.
        """
        values = self._sets.values(tuple([component[envs] for component in x]))
        self.steps[envs] = 0
        self.states[envs] = self.automaton.step(0, self.automaton.initial, self._labels(values))
        self.registers[:, envs] = self.specification.start(values)

    def advance(self, x: Components) -> None:
        """Append a state to each trace.

        Args:
            x: components of the states, each (B,).

        Raises:
            NumericalError: A set has no value there.
        """
        values = self._sets.values(x)
        self.steps = k = self.steps + 1
        self.states = self.automaton.step(k, self.states, self._labels(values))
        self.registers = self.specification.advance(k, self.registers, values)

    def report(self) -> Info:
        """Return what `info` says of the traces so far, fresh arrays (B,)."""
        return specification_info(
            robustness=self.specification.robustness(self.registers).copy(),
            satisfied=self.automaton.accepting[self.states],
            verdict=self.automaton.verdict(self.steps, self.states),
            automaton_state=self.states.copy(),
        )

    def _labels(self, values: np.ndarray) -> np.ndarray:
        return self._bits @ self._sets.inside(values)
