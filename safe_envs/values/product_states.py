"""States of an automaton in a dynamic program: those with a table, and where labels lead.

Where the verdict on a state is known, its value is 1 or 0 everywhere and needs no table.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from safe_envs.filters.specification import Automaton
from safe_envs.problem.regions import GOAL, SAFE


class Reading(NamedTuple):
    """What a state of the system shows at a control instant.

    Attributes:
        label: the sets of the specification in which it is.
        ends: whether the episode ends there.
        lost: whether that is a violation, whatever was reached before.
    """

    label: int
    ends: bool
    lost: bool


class Prospect(NamedTuple):
    """The values that may be read ahead of a state of the automaton.

    Attributes:
        known: those that are settled.
        tables: places of the tables of which the others are.
    """

    known: frozenset[float]
    tables: frozenset[int]


class ProductStates:
    """The states of an automaton that a dynamic program has tables of.

    Args:
        automaton: of a specification.

    Attributes:
        automaton: as given.
        live: states in which a trace may go on, and whose verdict is open at some instant, shape
            (L,); one at least.
        place: of each state among these, -1 for the others, shape (S,).
    """

    def __init__(self, automaton: Automaton) -> None:
        self.automaton = automaton
        going = sorted(_states_on_the_way(automaton))
        open_ = [a for a in going if (automaton.verdicts[:, a] == 0).any()]
        self.live = np.array(open_ or going[:1] or [automaton.initial])
        self.place = np.full(automaton.size, -1)
        self.place[self.live] = np.arange(len(self.live))
        self._prospects: dict[tuple[int, int, tuple[Reading, ...]], Prospect] = {}

    def prospect(self, k: int, state: int, readings: tuple[Reading, ...]) -> Prospect:
        """Return what may follow a state of the automaton.

        Args:
            k: control instant of the readings.
            state: of the automaton before it.
            readings: of which one is made.
        """
        key = int(self.automaton.phase(k)), state, readings
        if key not in self._prospects:
            self._prospects[key] = self._followed(*key)
        return self._prospects[key]

    def reached(self, k: int, readings: Iterable[Reading]) -> tuple[set[int], set[int]]:
        """Return the states of the automaton in which an episode may be after a reading.

        Args:
            k: control instant.
            readings: of which one is made.

        Returns:
            The states in which it goes on, and those in which it ends.
        """
        phases = {int(self.automaton.phase(k)), int(self.automaton.phase(max(k, 1)))}
        on: set[int] = set()
        over: set[int] = set()
        for label, ends, lost in readings:
            following = {
                int(a) for p in phases for a in self.automaton.transitions[p][:, label].tolist()
            }
            if ends:
                over |= set() if lost else following
            else:
                on |= following
        return on, over

    def _followed(self, phase: int, state: int, readings: tuple[Reading, ...]) -> Prospect:
        known, tables = set(), set()
        for label, ends, lost in readings:
            after = int(self.automaton.transitions[phase, state, label])
            verdict = self.automaton.verdicts[phase, after]
            if lost:
                known.add(0.0)
            elif ends:
                known.add(float(self.automaton.accepting[after]))
            elif verdict:
                known.add(1.0 if verdict > 0 else 0.0)
            else:
                tables.add(int(self.place[after]))
        return Prospect(frozenset(known), frozenset(tables))


def _states_on_the_way(automaton: Automaton) -> set[int]:
    """Return the states that follow labels without the goal, where an episode would end."""
    labels = np.arange(automaton.transitions.shape[2])
    if GOAL in automaton.atoms:
        labels = labels[labels >> automaton.atoms.index(GOAL) & 1 == 0]
    found: set[int] = set()
    following = set(automaton.transitions[0, automaton.initial, labels].tolist())
    while following - found:
        found |= following
        following = set(automaton.transitions[:, sorted(found)][..., labels].ravel().tolist())
    return found


def keeps_safe(automaton: Automaton) -> bool:
    """Return whether every trace that may satisfy the specification is safe at all instants."""
    if SAFE not in automaton.atoms:
        return False
    bit = 1 << automaton.atoms.index(SAFE)
    unsafe = np.array([i for i in range(automaton.transitions.shape[2]) if not i & bit])
    phases = np.arange(len(automaton.begins))[:, None, None]
    return bool((automaton.verdicts[phases, automaton.transitions[:, :, unsafe]] == -1).all())
