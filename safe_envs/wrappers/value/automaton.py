"""Deterministic automata over finite traces, and what a dynamic program does with one.

`safe_envs.wrappers.value.automaton_building` makes them of specifications.

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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


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
