"""What a promise filter remembers of episodes: control instant, what is kept, and its automaton."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.envs.info import Info
from safe_envs.errors import InvalidInputError, NotCompilableError
from safe_envs.wrappers.filter_qp import FilterDecision
from safe_envs.wrappers.value.product_look_ahead import ProductLookAhead
from safe_envs.wrappers.value.promise_filter import PromiseChoice, PromiseFilter

ROUNDING = 1e-9
"""The part of p_k that rounding may cost."""

_NAMES = ("instant", "promise", "promise_ended", "promise_automaton")


class PromiseMemory:
    """A promise filter in the episodes of a batch of envs, or of one env as a batch of one.

    See `safe_envs.wrappers.env_wrappers.episode_filter` for the methods.

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
