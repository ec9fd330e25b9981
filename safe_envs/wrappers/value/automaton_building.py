"""The automaton of a specification, by unfolding its registers and joining equal states.

The states are the truth values of the registers of `Specification`: what is to be known of the
labels so far. They are those that occur, each instant by itself, since windows that are counted
from the start make the transitions depend on time; states with the same future are one state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.named_sets import set_expressions, set_names
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.automaton import Automaton
from safe_envs.wrappers.value.specification import Specification

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
    """Return the initial state and the transitions of instant 0.

    Only the initial state has any then, so that it can be one that has these later, or else any.

    Args:
        first: state after each label of instant 0.
        table: transitions of instant 1.
    """
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
