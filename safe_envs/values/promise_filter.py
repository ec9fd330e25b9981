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

`spec=always safe & eventually goal` says what is kept in place of safety. No sign of a
specification divides the text of a filter, so that it is written as it is.
"""

from __future__ import annotations

import json
import math
import re
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, NoReturn

import numpy as np

from safe_envs.dynamics.codegen import Components, compile_function, stacked
from safe_envs.envs.info import Info
from safe_envs.errors import (
    ConfigurationError,
    InvalidInputError,
    NotCompilableError,
    nearest,
    shown,
)
from safe_envs.filters.conditions.names import PROMISE
from safe_envs.filters.conditions.text import FilterSettings, settings_in
from safe_envs.filters.qp import FilterDecision
from safe_envs.filters.specification import Specification, automaton_of
from safe_envs.problem.named_sets import set_names
from safe_envs.problem.problem import SafetyProblem
from safe_envs.text import finite_number, real
from safe_envs.values.images import StepValues
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.product_states import keeps_safe
from safe_envs.values.products import ProductLookAhead, read_for
from safe_envs.values.reduction import reduced
from safe_envs.values.solve import table_for
from safe_envs.values.tables import LEAVING, ValueSettings

_KEYS = ("p", "robust", "leaving", "spec", "table")
_EXAMPLE = f"{PROMISE}:p=0.99"
_SPEC_EXAMPLE = "like always safe & eventually goal"

_INTERVAL = re.compile(r"\s*(\w+)\s*:(.+?)\.\.(.+)")

Interval = tuple[str, float, float]
"""Name, lower and upper end of a parameter."""


@dataclass(frozen=True)
class PromiseSettings(FilterSettings):
    """What a promise filter is asked for.

    Attributes:
        probability: p, between 0 and 1.
        robust: parameters of which only an interval is known, each once.
        leaving: how an episode counts that leaves the workspace in the safe set: as a
            "violation", or as "safe".
        table: file of the table; None for the one of the user's cache, which is computed where it
            is missing.
        specification: that an episode is to meet, over the sets that the problem names; "" for that
            of staying safe.

    Raises:
        ConfigurationError: A value is out of range.
    """

    name = PROMISE
    only_of_steps = "its table is of the env's own steps"
    not_compiled = "looks up a table, which the engine 'numpy' alone can"
    of_paths = "what was kept on the whole path"

    probability: float
    robust: tuple[Interval, ...] = ()
    leaving: str = LEAVING[0]
    table: str | None = None
    specification: str = ""

    def __post_init__(self) -> None:
        p = finite_number("p of the promise filter", self.probability)
        if not 0.0 < p < 1.0:
            raise ConfigurationError(
                f"p = {p:g} of the promise filter; give a probability of being safe between 0 and"
                f" 1, both excluded, like {_EXAMPLE}"
            )
        object.__setattr__(self, "probability", p)
        if self.leaving not in LEAVING:
            raise ConfigurationError(
                f"leaving = {shown(self.leaving)} of the promise filter;"
                f" {nearest(str(self.leaving), LEAVING)}"
            )
        if not isinstance(self.specification, str):
            raise ConfigurationError(
                f"specification = {shown(self.specification)} of the promise filter; give text,"
                f" {_SPEC_EXAMPLE}"
            )
        object.__setattr__(self, "specification", " ".join(self.specification.split()))
        names = [name for name, _, _ in self.robust]
        for name, low, high in self.robust:
            if names.count(name) > 1:
                raise ConfigurationError(f"robust of the promise filter names {name} twice")
            if not (math.isfinite(low) and math.isfinite(high) and low <= high):
                raise ConfigurationError(
                    f"robust = {name}:{low:g}..{high:g} of the promise filter; give two finite"
                    " numbers, the lower one first"
                )

    @classmethod
    def of_text(cls, text: str) -> PromiseSettings:
        """Read the text of a promise filter.

        Args:
            text: `promise:p=0.99`, and if need be `:robust=v:0.8..2.4` (several parameters with ";"
                between), `:leaving=safe`, `:spec=always safe & eventually goal` and
                `:table=FILE`.

        Raises:
            ConfigurationError: It has another form, or a value is out of range.
        """
        given = settings_in(text, PROMISE, _KEYS, _EXAMPLE)
        if "p" not in given:
            raise ConfigurationError(
                f"filter {shown(text)} names no probability; give one, like {_EXAMPLE}"
            )
        table = given.get("table")
        if table is not None and not table:
            raise ConfigurationError(f"filter {shown(text)}: table names no file")
        if "spec" in given and not given["spec"].strip():
            raise ConfigurationError(
                f"filter {shown(text)}: spec has no specification; give one, {_SPEC_EXAMPLE}, or"
                " leave it out for safety"
            )
        return cls(
            finite_number("p of the promise filter", given["p"]),
            _intervals(text, given["robust"]) if "robust" in given else (),
            given.get("leaving", LEAVING[0]),
            table,
            given.get("spec", ""),
        )

    @property
    def text(self) -> str:
        """The text from which `of_text` makes the same settings."""
        parts = [f"{PROMISE}:p={self.probability!r}"]
        if self.robust:
            parts.append("robust=" + ";".join(f"{n}:{a!r}..{b!r}" for n, a, b in self.robust))
        if self.leaving != LEAVING[0]:
            parts.append(f"leaving={self.leaving}")
        if self.specification:
            parts.append(f"spec={self.specification}")
        if self.table is not None:
            parts.append(f"table={self.table}")
        return ":".join(parts)

    @property
    def intervals(self) -> Mapping[str, tuple[float, float]]:
        """The intervals by the names of their parameters."""
        return {name: (low, high) for name, low, high in self.robust}

    def require_fit(self, problem: SafetyProblem, objective: str = "nearest") -> None:
        """Raise ConfigurationError where the settings do not fit a problem.

        Args:
            problem: whose parameters are meant.
            objective: of the filter.
        """
        known = problem.model.parameter_values
        for name, _, _ in self.robust:
            if name not in known:
                raise ConfigurationError(
                    f"robust of the promise filter: {problem.name} has no parameter {shown(name)};"
                    f" {nearest(name, known)}"
                )
        if self.specification:
            specification = Specification(self.specification, set_names(problem))
            specification.require_horizon(problem.steps)
            automaton_of(specification)
        self.require_nearest(objective)


def _intervals(text: str, given: str) -> tuple[Interval, ...]:
    """Read "v:0.8..2.4;m:1..2"."""
    found = []
    for part in given.split(";"):
        match = _INTERVAL.fullmatch(part)
        try:
            name, low, high = match.groups() if match else ("", "", "")
            found.append((name, real(low), real(high)))
        except ValueError as error:
            raise ConfigurationError(
                f"filter {shown(text)}: robust = {shown(part)}; give a parameter and two numbers,"
                ' like v:0.8..2.4, with ";" between several of them'
            ) from error
    return tuple(found)


_SHARES = np.arange(1, 8) / 8.0
"""Where an interval is searched at once for an input nearer to the proposed one."""

_SEARCHES = 2
"""How often; together they divide the distance of two scanned inputs by 64."""

_COARSE = 8
"""Distances of the inputs that are looked at first, of each input."""

_TINY = 1e-300
"""A distance that can divide."""

_OF_CHAIN = (
    "plant",
    "model",
    "barriers",
    "states",
    "input_bounds",
    "goal",
    "dt",
    "substeps",
    "steps",
)


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
        self._low, self._high = np.array(problem.input_bounds, dtype=float).T
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
        """Go from allowed inputs towards the proposed ones, as far as q_k is seen to allow it."""
        # q_k need not be monotone on the way: only inputs whose own q_k is large enough are taken.
        # The way beyond the next of the inputs that were looked at, not allowed, is left out.
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
    """Return the nearest allowed inputs, of V (V, m) whose q_k are (B, V), and their q_k."""
    # Where none is allowed it is another one, with a q_k below the level.
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


ROUNDING = 1e-9
"""The part of p_k that rounding may cost."""

_NAMES = ("instant", "promise", "promise_ended", "promise_automaton")


class PromiseMemory:
    """A promise filter in the episodes of a batch of envs, or of one env as a batch of one.

    See `safe_envs.wrappers.filter_layers` for the methods.

    Args:
        promise_filter: which decides.
        num_envs: size of the batch.

    Attributes:
        safety_filter: the filter.
        text: of its settings.
        judges_episodes: whether the promise is of a specification, which is of whole episodes.
        levels: p_k of each episode, what is still kept; shape (num_envs,).
        asked: p of the episodes that begin from now on, at most that of the filter.
        losses: how often p_k had to be lowered by more than rounding, which a right table never
            makes necessary.
        largest_loss: by which it was.
    """

    def __init__(self, promise_filter: PromiseFilter, num_envs: int) -> None:
        self.safety_filter, self.text = promise_filter, promise_filter.text
        self._last = promise_filter.look_ahead.steps - 1
        self._instants = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=bool)
        # Of the automaton of a specification; 0 for that of staying safe.
        self._states = np.zeros(num_envs, dtype=np.int64)
        ahead = promise_filter.look_ahead
        self._product = ahead if isinstance(ahead, ProductLookAhead) else None
        self.judges_episodes = self._product is not None
        self._expected = np.ones(num_envs)
        self._caps = np.full(num_envs, np.inf)
        self.levels = np.zeros(num_envs)
        self.asked = promise_filter.settings.probability
        self.losses, self.largest_loss = 0, 0.0
        count = len(promise_filter.problem.barriers)
        self._barriers = count
        # A constraint on all barriers together has no single one as its cause.
        self._cause = 0 if count == 1 else -1

    def begin(self, x: Sequence[Any], envs: np.ndarray | None = None, instants: Any = 0) -> None:
        """Begin episodes.

        Args:
            x: n components of the states.
            envs: which begin, bool (num_envs,); None for all.
            instants: control periods that have passed, int or (num_envs,); 0 for a specification.
        """
        chosen = slice(None) if envs is None else np.flatnonzero(envs)
        starts = tuple([c[chosen] for c in _arrays(x)])
        if len(starts[0]):
            k = self._go_to(chosen, instants)
            self._ended[chosen] = False
            self.levels = self.levels.copy()
            self.levels[chosen] = np.minimum(self.safety_filter.start(starts, k), self.asked)
            if self._product is not None:
                pairs = self._product.starts(starts)
                self._states[chosen] = pairs[-1]
                sure = self._product.settled(k, pairs) == 1.0
                self.levels[chosen] = np.where(sure, 1.0, self.levels[chosen])

    def resume(self, x: Sequence[Any], envs: np.ndarray, instants: Any) -> None:
        """Promise anew from states that somebody set: what was promised was of others.

        Of a specification the traces stay what they are up to the states that were replaced.

        Args:
            x: n components of the states.
            envs: whose states were set, bool (num_envs,).
            instants: control periods that have passed, int or (num_envs,).
        """
        chosen = np.flatnonzero(envs)
        at, k = tuple([c[chosen] for c in _arrays(x)]), self._go_to(chosen, instants)
        self.levels = self.levels.copy()
        if self._product is None:
            self.levels[chosen] = np.minimum(self.safety_filter.start(at, k), self.asked)
            return
        pairs = (*at, self._states[chosen])
        # A table takes an episode to be over in a goal, but it is not over before the next step.
        is_open = np.isnan(self._product.settled(k, pairs))
        promised = np.where(is_open, self.safety_filter.attainable(k, pairs), 0.0)
        promised = np.minimum(promised, self.asked)
        self.levels[chosen] = np.where(self._product.met(k, pairs[-1]), 1.0, promised)

    def _go_to(self, chosen: Any, instants: Any) -> np.ndarray:
        """Set the control instants of some episodes; return them, at most the table's last."""
        self._instants = self._instants.copy()
        self._instants[chosen] = np.broadcast_to(instants, self._instants.shape)[chosen]
        return np.minimum(self._instants[chosen], self._last)

    def decide_floats(self, x: Sequence[float], u: Sequence[float]) -> FilterDecision:
        """Decide for one state; see `SafetyFilter.decide_floats`.

        Args:
            x: n components of the state.
            u: m components of the proposed input.

        Returns:
            The decision in components.
        """
        found = self.decide_arrays(_arrays(x), _arrays(u))
        replaced = found.active[0].item()
        return FilterDecision(
            [c.item() for c in found.action] if replaced else list(u),
            [c.item() for c in found.margin],
            [replaced],
            found.feasible.item(),
            [c.item() for c in found.slack],
            self._cause,
            u,
        )

    def decide_arrays(self, x: Components, u: Components) -> FilterDecision:
        """Decide for the batch; see `SafetyFilter.decide_arrays`.

        Args:
            x: n components of the states.
            u: m components of the proposed inputs.

        Returns:
            The decisions in components. All barriers share one constraint and its slack.
        """
        # Beyond the last instant of the table nothing is kept.
        wanted = np.where(self._ended | (self._instants > self._last), 0.0, self.levels)
        k = np.minimum(self._instants, self._last)
        if self._product is None:
            found = self.safety_filter.choose(k, wanted, x, u)
        else:
            found = self._chosen_of_pairs(self._product, k, wanted, x, u)
        action, expected, level, replaced, self._caps = found
        self._expected, self.levels = expected, level
        loss = wanted - level
        if np.count_nonzero(loss):
            self.losses += int(np.count_nonzero(loss > ROUNDING * wanted))
            self.largest_loss = max(self.largest_loss, float(loss.max()))
        margin, count = expected - level, self._barriers
        return FilterDecision(
            action, (margin,) * count, (replaced,), level > 0.0, (loss,) * count, self._cause, u
        )

    def advance(self, x: Sequence[Any], ended: Any) -> None:
        """Go on to the states that the decided inputs led to.

        Args:
            x: n components of the states, before any of them is replaced by a start.
            ended: the envs whose episode is over, bool (num_envs,).
        """
        self._instants = self._instants + 1
        k, held = np.minimum(self._instants, self._last + 1), self.levels > 0.0
        reached_at, sure = _arrays(x), None
        if self._product is not None:
            sure = held & self._product.met(np.maximum(k - 1, 0), self._states)
            reached_at = self._product.following(k, reached_at, self._states)
            self._states = reached_at[-1]
            # What is met before the workspace is left, counts.
            sure |= held & (self._product.settled(k, reached_at) == 1.0)
        reached = self.safety_filter.look_ahead.values(k, reached_at)
        share = self.levels / np.where(held, self._expected, 1.0)
        # Without a cap, in proportion to the value that was reached.
        wanted = np.where(self._caps < np.inf, self._caps, share * reached)
        self.levels = np.where(held, np.minimum(np.maximum(wanted, 0.0), reached), 0.0)
        if sure is not None:
            self.levels[sure] = 1.0
        self._ended = self._ended | ended

    def _chosen_of_pairs(
        self,
        product: ProductLookAhead,
        k: np.ndarray,
        wanted: np.ndarray,
        x: Components,
        u: Components,
    ) -> PromiseChoice:
        """Choose inputs for a specification; the proposed ones where it is violated for good."""
        pairs = (*x, self._states)
        found = self.safety_filter.choose(k, wanted, pairs, u)
        lost = np.flatnonzero((found.level <= 0.0) & (product.settled(k, pairs) == 0.0))
        if lost.size:
            for component, proposed in zip(found.action, u, strict=True):
                component[lost] = proposed[lost]
            found.replaced[lost] = False
        return found

    def report(self) -> Info:
        """Return p_k of the state that was reached last, by its name in the info."""
        return {"promise": self.levels.copy()}

    def source(self, data: Any) -> NoReturn:
        """Raise NotCompilableError: NumPy decides."""
        raise NotCompilableError(
            f"the filter {self.text} looks up a table, for which there is no compiled form"
        )

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return where each episode is, in arrays with the batch in front."""
        found = (self._instants, self.levels, self._ended, self._states)
        return {name: each.copy() for name, each in zip(_NAMES, found, strict=True)}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Put each episode where a snapshot has it.

        Raises:
            InvalidInputError: The snapshot is of envs without a promise filter, or of none.
        """
        missing = [name for name in _NAMES if name not in snapshot]
        if missing:
            raise InvalidInputError(
                f"the snapshot has no {', '.join(missing)}: it is of envs without a promise filter;"
                " take one of envs with it"
            )
        instants, levels, ended, states = [np.array(snapshot[name]) for name in _NAMES]
        levels, shape = levels.astype(float), self.levels.shape
        if not (
            instants.shape == levels.shape == ended.shape == states.shape == shape
            and instants.min() >= 0
            and levels.min() >= 0.0
            and levels.max() <= 1.0
        ):
            raise InvalidInputError(
                f"the snapshot has no instant and no promise in [0, 1] for each of {shape[0]} envs;"
                " take one of envs with a promise filter"
            )
        self._instants, self._ended = instants.astype(np.int64), ended.astype(bool)
        self.levels, self._states = levels, states.astype(np.int64)


def _arrays(components: Sequence[Any]) -> Components:
    return tuple([np.atleast_1d(np.asarray(c, dtype=float)) for c in components])


_IN_USE: weakref.WeakValueDictionary[str, LookAhead] = weakref.WeakValueDictionary()
"""Tables that some filter looks up, of this process."""


def promise_filter_for(
    problem: SafetyProblem,
    settings: PromiseSettings,
    knowledge: str = "model",
    progress: Callable[[float], None] | None = None,
) -> PromiseFilter:
    """Return the promise filter of a problem, whose table may have to be computed first.

    Args:
        problem: that is to be kept safe.
        settings: what is asked for.
        knowledge: whose step is in the table, that of the "model" or of the "plant".
        progress: called with the part of the table that is computed, from 0 to 1.

    Raises:
        ConfigurationError: The settings do not fit the problem, it has too many coordinates or
            unbounded ones, or the file of a table is of another problem.
    """
    settings.require_fit(problem)
    wanted = ValueSettings(
        knowledge=knowledge,
        leaving=settings.leaving,
        intervals=settings.intervals,
        specification=settings.specification,
    )
    fingerprint = reduced(
        problem, knowledge, settings.intervals, settings.specification
    ).fingerprint
    if problem.model == problem.plant:
        # Then a table of the plant is one of the model, and may be there already.
        wanted = replace(wanted, knowledge="plant")
    key = json.dumps([fingerprint, wanted.as_dict(), settings.table])
    look_ahead = _IN_USE.get(key)
    if look_ahead is None:
        table = table_for(problem, wanted, progress, settings.table)
        look_ahead = _IN_USE[key] = LookAhead(table, problem)
    if progress is not None:
        progress(1.0)
    return PromiseFilter(look_ahead, settings, problem)


def why_not_of_plant(problem: SafetyProblem, settings: PromiseSettings, knowledge: str) -> str:
    """Return why the guarantee of a promise filter is not one for the plant; "" where it is.

    Args:
        problem: that is to be kept safe.
        settings: of the filter.
        knowledge: of the filter, "model" or "plant".
    """
    true = problem.plant.parameter_values
    outside = [
        f"{name} = {true[name]:g}"
        for name, low, high in settings.robust
        if name in true and not low <= true[name] <= high
    ]
    if outside:
        return f"the plant has {', '.join(outside)}, outside the intervals of the filter"
    if knowledge == "plant":
        return ""
    covered = {name: true[name] for name in settings.intervals if name in true}
    believed = replace(problem, model=problem.model.with_parameters(**covered))
    try:
        model, plant = (
            reduced(believed, whose, {}, settings.specification) for whose in ("model", "plant")
        )
        same = model.fingerprint == plant.fingerprint
    except ConfigurationError:
        same = False
    return "" if same else "the filter's guarantee is of the model, from which the plant differs"


def why_not_of_safety(problem: SafetyProblem, settings: PromiseSettings) -> str:
    """Return why the guarantee of a promise filter is not one of being safe; "" where it is.

    Args:
        problem: that is to be kept safe.
        settings: of the filter.
    """
    if not settings.specification:
        return ""
    specification = Specification(settings.specification, set_names(problem))
    if keeps_safe(automaton_of(specification)):
        return ""
    return f"it is of meeting {settings.specification!r}, which unsafe episodes may meet too"
