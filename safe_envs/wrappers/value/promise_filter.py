"""The promise filter: the input nearest to the proposed one that keeps a given probability.

Let C be the safe set, F the step of the env under a held input u and noise xi, and L_k, k = 0..K, a
table with 0 <= L_k <= 1 on C and L_k = 0 outside. Let q_k(x, u) <= E L_{k+1}(F(x, u, xi)), with
L_k(x) <= max q_k(x, .) over the inputs that are scanned, for every x of C. The filter begins with
p_0 = min(p, max q_0(x_0, .)), and with p_0 = 0 outside C. At control instant k it lowers p_k to max
q_k(x_k, .), executes the input u_k nearest to the proposed one with q_k(x_k, u_k) >= p_k, and goes
on with

    p_{k+1} = p_k L_{k+1}(x_{k+1}) / q_k(x_k, u_k).

Where the table shows what values the next states have, box of noise by box, and not only their
mean, the filter spends more evenly: with the least number c for which a lower bound of
E min(c, L_{k+1}(x_{k+1})) is p_k,

    p_{k+1} = min(c, L_{k+1}(x_{k+1})).

*Guarantee.* P(safe up to K) >= E p_0 for every policy, learned, random or hostile, that does not
know xi_k before it proposes u_k. Proof: since p_k <= q_k(x_k, u_k), p_{k+1} <= L_{k+1}(x_{k+1}) <=
max q_{k+1}(x_{k+1}, .). So nothing is ever lost by lowering p_k, but for rounding, and there always
is an input. Given the past, E p_{k+1} = p_k E L_{k+1}(x_{k+1}) / q_k(x_k, u_k) >= p_k, and with c
E p_{k+1} = E min(c, L_{k+1}(x_{k+1})) >= p_k: p is a submartingale. Outside C it is 0, and stays 0.
Hence p_K <= L_K(x_K) <= 1 where x_0..x_K are all in C, and p_K = 0 elsewhere, so that P(safe) >=
E p_K >= E p_0. An episode that ends safely before K stops p at a value of at most 1.

*What the guarantee is of.* The table's chain: that of the model, with knowledge = "plant" that of
the plant. Where the two differ, E L_{k+1} is another number under the plant, and nothing is
guaranteed; a filter that is robust over intervals of parameters covers the plants within them. It
covers control instants, not what lies between them, up to step K. Beyond K p_k is 0: it is not
renewed.

*A specification* in place of safety makes all this one of pairs z = (x, a) of a state and a state
of its automaton, with L_K(z) <= 1 where a accepts and 0 elsewhere, and likewise where an episode
ends. No barrier is looked at. The same proof says P(spec) >= E min(p, max q_0(z_0, .)) for every
policy, and this is at least the mean of min(p, L_0(z_0)). As soon as the specification is met
whatever follows, p_k is 1 and every input is allowed; p is still at most L, and has only grown. As
soon as it is violated, p_k is 0, and as no input is better than another, the proposed one is taken:
then nothing is kept, not even safety. A bound of P(safe) it is for a specification that no
episode meets that leaves C.

*Without a guarantee*, outside C, after the end of an episode, or where the table is 0, p_k is 0,
the filter says that it is infeasible, and it executes the input of the largest table value.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Components, compile_function, stacked
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.product_look_ahead import ProductLookAhead, read_for
from safe_envs.wrappers.value.promise_text import PromiseSettings
from safe_envs.wrappers.value.step_values import StepValues

_SHARES = np.arange(1, 8) / 8.0
"""Where an interval is searched at once for an input nearer to the proposed one."""

_SEARCHES = 2
"""How often; together they divide the distance of two scanned inputs by 64."""

_COARSE = 8
"""Distances of the inputs that are looked at first, of each input."""

_TINY = 1e-300
"""A distance that can divide."""

_OF_CHAIN = ("plant", "model", "barriers", "states", "box", "goal", "dt", "substeps", "steps")


class PromiseChoice(NamedTuple):
    """What the promise filter chooses for B states.

    Attributes:
        action: m components of the executed input, arrays (B,).
        expected: q_k there, shape (B,).
        level: p_k, lowered where no input keeps it, shape (B,).
        replaced: whether it is not the proposed input that is executed, shape (B,).
        caps: c, which no p_{k+1} needs to exceed, inf where none is known, shape (B,).
    """

    action: Components
    expected: np.ndarray
    level: np.ndarray
    replaced: np.ndarray
    caps: np.ndarray


class PromiseFilter:
    """Chooses the input nearest to a proposed one that keeps a probability of being safe.

    "Nearest" is in the Euclidean distance of physical units, as for `SafetyFilter`. The proposed
    input is taken as it is where its own q_k is large enough. Elsewhere a few scanned inputs are
    looked at, and all of them where none of these is allowed; from the nearest one a search goes
    towards the proposed input, to inputs whose own q_k was computed. Whether an input is the
    nearest one is decided with the resolution of this search, whether it is allowed exactly.

    The filter itself remembers nothing: `PromiseMemory` has the p_k of episodes.

    Args:
        look_ahead: of a table of the problem.
        settings: what is asked for.
        problem: that is to be kept safe.

    Attributes:
        settings: as given.
        problem: as given.
        look_ahead: as given; for a specification one of pairs.
        text: of the settings.
        coarse, coarse_spacing: inputs that are looked at first, and how far they are apart.

    Raises:
        ConfigurationError: The episodes of the problem are longer than the table.
    """

    def __init__(
        self, look_ahead: StepValues, settings: PromiseSettings, problem: SafetyProblem
    ) -> None:
        settings.require_fit(problem)
        look_ahead = read_for(look_ahead, settings.specification)
        if problem.steps > look_ahead.steps:
            raise ConfigurationError(
                f"episodes of {problem.name} have {problem.steps} steps, and the table of the"
                f" promise filter only {look_ahead.steps}: beyond it nothing is guaranteed. Give a"
                " table of this horizon, or a shorter horizon"
            )
        self.settings, self.problem, self.look_ahead = settings, problem, look_ahead
        self.text = settings.text
        self._low, self._high = np.array(problem.box, dtype=float).T
        self._barriers: Any = compile_function(
            problem.plant.states,
            [problem.plant.numeric(barrier.expression) for barrier in problem.barriers],
            "arrays",
        )
        self.coarse = _coarse(look_ahead.inputs)
        self.spacing, self.coarse_spacing = _spacing(look_ahead.inputs), _spacing(self.coarse)

    def __deepcopy__(self, memo: dict[int, Any]) -> PromiseFilter:
        """Return the filter itself: it never changes, and its table may be of gigabytes."""
        return self

    def require_problem(self, problem: SafetyProblem) -> None:
        """Raise ConfigurationError where the table is not of a problem."""
        for name in (*_OF_CHAIN, *(["regions"] if self.settings.specification else [])):
            if getattr(problem, name) != getattr(self.problem, name):
                raise ConfigurationError(
                    f"the promise filter was made for {self.problem.name}, which has another"
                    f" {name} than {problem.name}; make it for the env's own problem"
                )

    def start(self, x: Components, k: np.ndarray | None = None) -> np.ndarray:
        """Return p_0 at the starts of episodes.

        For a specification no barrier is looked at: q_0 is 0 where it is violated.

        Args:
            x: n components of the states, arrays (B,).
            k: control instants at which they start, int (B,); None for 0, as for a specification.

        Returns:
            min(p, max q_k) in the safe set and 0 outside, shape (B,).
        """
        k = np.zeros(len(x[0]), dtype=np.int64) if k is None else k
        if isinstance(self.look_ahead, ProductLookAhead):
            return self.attainable(k, self.look_ahead.starts(x))
        with np.errstate(all="ignore"):
            safe = (stacked(self._barriers(*x), len(x[0])) > 0.0).all(axis=1)
        return np.where(safe, self.attainable(k, x), 0.0)

    def attainable(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return min(p, max q_k), 0 where it is negative, shape (B,); see `choose`."""
        best = self.look_ahead.scanned(k, x).max(axis=1)
        return np.where(best > 0.0, np.minimum(best, self.settings.probability), 0.0)

    def choose(
        self, k: np.ndarray, level: np.ndarray, x: Components, u: Components
    ) -> PromiseChoice:
        """Choose inputs.

        Args:
            k: control instants, below K, int (B,).
            level: p_k, shape (B,); where it is 0 the best input is taken.
            x: n components of the states, or n + 1 of `ProductLookAhead`, arrays (B,).
            u: m components of the proposed inputs, within their bounds, arrays (B,).

        Returns:
            The choice for each state.
        """
        given = np.array(u).T
        found, caps = self.look_ahead.sufficient(k, x, given, level)
        replaced = ~((found >= level) & (level > 0.0))
        if not np.count_nonzero(replaced):
            return PromiseChoice(u, found, level, replaced, caps)
        rows = np.flatnonzero(replaced)
        action, found, level = given.copy(), np.array(found), level.copy()
        action[rows], found[rows], level[rows] = self._nearest(
            k[rows], level[rows], tuple([c[rows] for c in x]), given[rows]
        )
        kept = rows[level[rows] > 0.0]
        _, caps[kept] = self.look_ahead.sufficient(
            k[kept], _part(x, kept), action[kept], level[kept]
        )
        return PromiseChoice(tuple(np.ascontiguousarray(action.T)), found, level, replaced, caps)

    def _nearest(
        self, k: np.ndarray, level: np.ndarray, x: Components, given: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the inputs (B, m) in place of proposed ones, their q_k and the levels p_k."""
        level, ahead = level.copy(), self.look_ahead
        action, found = np.empty(given.shape), np.empty(len(given))
        spacing = np.full(len(given), self.coarse_spacing)
        held = np.flatnonzero(level > 0.0)
        values = ahead.expected(
            k[held],
            _part(x, held),
            np.broadcast_to(self.coarse, (len(held), *self.coarse.shape)),
        )
        action[held], found[held] = _closest(self.coarse, values, level[held], given[held])
        # What is between these inputs decides where none of them is allowed.
        open_ = held[found[held] < level[held]]
        if open_.size:
            values, spacing[open_] = ahead.scanned(k[open_], _part(x, open_)), self.spacing
            level[open_] = np.minimum(level[open_], np.maximum(values.max(axis=1), 0.0))
            action[open_], found[open_] = _closest(ahead.inputs, values, level[open_], given[open_])
        held = np.flatnonzero(level > 0.0)
        at = k[held], _part(x, held)
        action[held], found[held] = self._nearer(
            at, level[held], given[held], (action[held], found[held]), spacing[held]
        )
        lost = np.flatnonzero(level <= 0.0)
        if lost.size:
            best, found[lost] = ahead.best_input(k[lost], _part(x, lost))
            action[lost] = np.clip(best, self._low, self._high)
        return action, found, level

    def _nearer(
        self,
        at: tuple[np.ndarray, Components],
        level: np.ndarray,
        given: np.ndarray,
        begun: tuple[np.ndarray, np.ndarray],
        spacing: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Go from allowed inputs towards the proposed ones, as far as q_k is seen to allow it.

        q_k need not be monotone on the way: only inputs whose own q_k is large enough are taken.
        The way beyond the next of the inputs that were looked at, not allowed, is left out.
        """
        action, found = begun
        way = given - action
        length = np.sqrt((way**2).sum(axis=1))
        width = spacing / np.maximum(np.maximum(length, spacing), _TINY)
        gone, rows, origin = np.zeros(len(way)), np.arange(len(way)), action
        for _ in range(_SEARCHES):
            share = gone[:, None] + width[:, None] * _SHARES
            points = origin[:, None, :] + share[:, :, None] * way[:, None, :]
            points = np.clip(points, self._low, self._high)
            values = self.look_ahead.expected(*at, points)
            allowed = values >= level[:, None]
            last = len(_SHARES) - 1 - allowed[:, ::-1].argmax(axis=1)
            moves = allowed[rows, last]
            gone = np.where(moves, share[rows, last], gone)
            action = np.where(moves[:, None], points[rows, last], action)
            found = np.where(moves, values[rows, last], found)
            width = width / (len(_SHARES) + 1)
        return action, found


def _closest(
    inputs: np.ndarray, values: np.ndarray, level: np.ndarray, given: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest allowed inputs, of V (V, m) whose q_k are (B, V), and their q_k.

    Where none is allowed it is another one, with a q_k below the level.
    """
    distance = sum((inputs[:, j] - given[:, j, None]) ** 2 for j in range(inputs.shape[1]))
    where = np.where(values >= level[:, None], distance, np.inf).argmin(axis=1)
    return inputs[where], np.take_along_axis(values, where[:, None], axis=1)[:, 0]


def _part(x: Components, rows: np.ndarray) -> Components:
    return tuple([c[rows] for c in x])


def _coarse(inputs: np.ndarray) -> np.ndarray:
    """Return about nine values of each input among scanned ones, in all combinations."""
    chosen = np.ones(len(inputs), dtype=bool)
    for column in inputs.T:
        values = np.unique(column)
        stride = max(1, (len(values) - 1) // _COARSE)
        chosen &= np.isin(column, [*values[::stride], values[-1]])
    return inputs[chosen] if chosen.any() else inputs


def _spacing(inputs: np.ndarray) -> float:
    """Return how far neighbours among scanned inputs (U, m) are apart, at most."""
    gaps = [np.diff(np.unique(column), prepend=column.min()).max() for column in inputs.T]
    return float(np.sqrt(np.sum(np.square(gaps))))
