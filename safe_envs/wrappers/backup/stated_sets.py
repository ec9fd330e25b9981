"""Samples of terminal sets that are stated: does the law keep them?

A filter takes T_j, as far as it is safe, for a set that law j never leaves. Who states T_j answers
for that. Here states of it are drawn, in its interior and at its edge, where a set is left first,
and one period of the law is simulated from each. What is found is refused; where nothing is found,
nothing is proved.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import filled
from safe_envs.errors import ConfigurationError, SystemDefinitionError
from safe_envs.wrappers.backup.plans import Plans

_COUNT = 2000
_FOLLOWED = 20
"""Control periods for which the law is followed from the samples, to see more of its set."""
_HALVINGS = 30
_ROUNDING = 1e-7
"""Of the median size of an expression: what rounding may take away."""


def sampled_states(problem: Any) -> np.ndarray:
    """Return states of a problem's workspace and starts, shape (B, n); the same ones every time.

    Args:
        problem: a `SafetyProblem`; where its workspace has no end, the region from which it is
            learned stands for it, or what is around its starts.
    """
    rng = np.random.default_rng(0)
    starts = problem.starts[problem.start].proposals(_COUNT // 4)
    regions = problem.sampling.region or ((-np.inf, np.inf),) * len(problem.states)
    ends = []
    for at, state, region in zip(starts.T, problem.states, regions, strict=True):
        low, high = (state.low, state.high) if np.isfinite(state.high - state.low) else region
        if not np.isfinite(high - low):
            width = max(np.ptp(at), np.pi if state.unit == "rad" else 1.0)
            low, high = at.min() - width, at.max() + width
        ends.append((low, high))
    low, high = np.array(ends).T
    return np.concatenate([starts, rng.uniform(low, high, (_COUNT, len(low)))])


def require_kept(
    plans: Plans, laws: Iterable[int], states: np.ndarray, margin: float = 0.0
) -> None:
    """Raise SystemDefinitionError where a law leaves its terminal set at a sampled state.

    With noise a period is not that of the env, so that only the law's numbers are looked at.

    Args:
        plans: of the laws.
        laws: indices of those that are sampled.
        states: shape (B, n).
        margin: of the filter.

    Raises:
        ConfigurationError: No state of a set keeps the margin.
    """
    x = np.array(plans.part(tuple(states.T)))
    with np.errstate(all="ignore"):
        for j in laws:
            _require_kept(plans, j, x, margin)


class _Read:
    """Readings of a law at states: the safe height, the terminal expression and the inputs."""

    def __init__(self, plans: Plans, j: int, x: np.ndarray) -> None:
        at = tuple(x)
        values = plans.compiled["arrays"][j](*at)
        rows = [filled(v, x.shape[1:]) for v in values]
        self.height = np.min(rows[: plans.count], axis=0)
        self.terminal = rows[plans.count]
        self.law = np.array(rows[plans.count + 1 :])
        self.inside = (self.height >= 0.0) & (self.terminal >= 0.0)
        self._plans, self._at, self._values = plans, at, values

    def advanced(self) -> np.ndarray:
        """Return the states one period later."""
        u = self._plans.clipped_arrays(self._values, self._at)
        return np.array(self._plans.advanced(self._at, u))


def _require_kept(plans: Plans, j: int, x: np.ndarray, margin: float) -> None:
    found, outside = [], x
    read = _Read(plans, j, x)
    sizes = [np.nanmedian(np.abs(e)) for e in (read.terminal, read.height)]
    for _ in range(_FOLLOWED):
        found.append(x[:, read.inside])
        x = read.advanced()
        read = _Read(plans, j, x)
    inside = np.concatenate(found, axis=1)
    if not inside.size:
        return
    outside = outside[:, ~_Read(plans, j, outside).inside]
    inside = np.concatenate([inside, _at_edge(plans, j, inside, outside)], axis=1)
    read = _Read(plans, j, inside)
    if read.height.max() < margin:
        raise ConfigurationError(
            f"margin = {margin:g} of the backup filter: on the terminal set of backup law"
            f" {plans.laws[j].name} the smallest barrier is {read.height.max():.3g} at most, of"
            f" {read.height.size} sampled states; give a smaller margin"
        )
    lost = ~np.isfinite(read.law).all(axis=0)
    what = "the law gives no finite input"
    if not lost.any() and not plans.system.noisy:
        after = _Read(plans, j, read.advanced())
        lost = ~(after.terminal >= -_ROUNDING * sizes[0])
        what = "the law leaves it within a control period"
        if not lost.any():
            lost = ~(after.height >= -_ROUNDING * sizes[1])
            what = "the law leads to an unsafe state within a control period"
    if lost.any():
        names = [s.name for s in plans.system.states]
        at = inside[:, lost.argmax()]
        where = ", ".join(f"{n} = {c:.6g}" for n, c in zip(names, at, strict=True))
        raise SystemDefinitionError(
            f"terminal set of backup law {plans.laws[j].name}: at {where}, which is in it, {what};"
            " state a set that the law keeps for good, or an equilibrium, from which one is"
            " derived and proved"
        )


def _at_edge(plans: Plans, j: int, inside: np.ndarray, outside: np.ndarray) -> Any:
    """Return states of the set between others in it and out of it, by bisection."""
    if not outside.size:
        return inside[:, :0]
    rng = np.random.default_rng(1)
    a, b = (e[:, rng.integers(e.shape[1], size=_COUNT)] for e in (inside, outside))
    for _ in range(_HALVINGS):
        middle = 0.5 * a + 0.5 * b
        kept = _Read(plans, j, middle).inside
        a, b = np.where(kept, middle, a), np.where(kept, b, middle)
    return a
