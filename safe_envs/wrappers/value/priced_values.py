"""Returns at prices of a violation, and the inputs that attain them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safe_envs.dynamics.codegen import Components, filled
from safe_envs.errors import ConfigurationError, require_whole, shown
from safe_envs.wrappers.value.node_grid import NodeGrid
from safe_envs.wrappers.value.priced_steps import PricedStep
from safe_envs.wrappers.value.rewarded import RewardedProblem
from safe_envs.wrappers.value.settings import LEAVING


@dataclass(frozen=True)
class FrontierSettings:
    """What a frontier is asked for, next to a problem.

    Attributes:
        prices: number of prices, 0 among them.
        policies: number of prices whose policy is kept.
        cells: number of nodes along each coordinate; None for numbers that suit.
        leaving: how an episode counts that leaves the workspace in the safe set: as a "violation",
            or as "safe", which is how `evaluate` counts it.

    Raises:
        ConfigurationError: A value is not allowed.
    """

    prices: int = 12
    policies: int = 6
    cells: tuple[int, ...] | None = None
    leaving: str = "violation"

    def __post_init__(self) -> None:
        require_whole("prices", self.prices, 2)
        require_whole("policies", self.policies, 0)
        for count in self.cells or ():
            require_whole("cells", count, 4)
        if self.leaving not in LEAVING:
            raise ConfigurationError(
                f"leaving = {shown(self.leaving)}; choose one of {', '.join(LEAVING)}"
            )


@dataclass(frozen=True, eq=False)
class PricedValues:
    """Largest returns less the price of a violation, and inputs that attain them.

    Attributes:
        given: the problem.
        settings: what was asked for.
        prices: increasing, from 0, shape (P,).
        values: mean over the starts of the return less the price, shape (P,).
        inputs: that were tried, in physical units, shape (U, m).
        safe_grid: nodes around the safe set.
        whole_grid: nodes of the workspace.
        known: place of each node of `safe_grid` in the tables, -1 for none.
        step: a control period.
        of_policies: numbers of the prices whose policy can be asked for.
        safe_start: of the safe nodes at instant 0 for all prices, shape (safe nodes, P).
        violated_start: after a violation, at instant 0, shape (nodes, 1).
        safe_values: of the safe nodes at the instants 1 to K, shape (K, safe nodes, policies),
            float32.
        violated_values: after a violation, at the same instants, shape (K, nodes), float32.
        violated_choice: number of the best input then, at the instants 0 to K - 1, the same shape.
        seconds: that the computation took.
    """

    given: RewardedProblem
    settings: FrontierSettings
    prices: np.ndarray
    values: np.ndarray
    inputs: np.ndarray
    safe_grid: NodeGrid
    whole_grid: NodeGrid
    known: np.ndarray
    step: PricedStep
    of_policies: np.ndarray
    safe_start: np.ndarray
    violated_start: np.ndarray
    safe_values: np.ndarray
    violated_values: np.ndarray
    violated_choice: np.ndarray
    seconds: float

    @property
    def least_violations(self) -> float:
        """The smallest chance of a violation that the largest prices lead to."""
        slope = (self.values[-2] - self.values[-1]) / (self.prices[-1] - self.prices[-2])
        return float(np.clip(slope, 0.0, 1.0))

    def largest_return(self, violations: np.ndarray) -> np.ndarray:
        """Return the largest mean return at chances of a violation, concave in these.

        Args:
            violations: in [0, 1], any shape.
        """
        lines = self.values + np.asarray(violations)[..., None] * self.prices
        return lines.min(axis=-1)

    def at_starts(self, x: Components) -> np.ndarray:
        """Return the values of starts for all prices, shape (B, P).

        Args:
            x: n components of the states, (B,).
        """
        given = self.given.small.of_states(tuple(np.asarray(c, dtype=np.float64) for c in x))
        q = [filled(c, np.shape(x[0])) for c in given]
        numbers, shares = self.safe_grid.corners(q)
        places = self.known[numbers]
        shares = np.where(places >= 0, shares, 0.0)
        total = shares.sum(axis=0)
        found = np.einsum("cb,cbp->bp", shares, self.safe_start[np.maximum(places, 0)])
        found /= np.where(total > 0.0, total, 1.0)[:, None]
        lost = self.whole_grid.interpolated(self.violated_start, q) - self.prices
        return np.where(self.step.is_safe(q)[:, None], found, lost)

    def inputs_at(self, k: int, x: Components, violated: np.ndarray, price: int) -> np.ndarray:
        """Return the inputs that are best at states, by a step of look-ahead where all is safe.

        Args:
            k: control instant before K.
            x: n components of the states, (B,).
            violated: which episodes had a violation, shape (B,).
            price: place in `of_policies`.

        Returns:
            In physical units, shape (B, m).
        """
        given = self.given.small.of_states(tuple(np.asarray(c, dtype=np.float64) for c in x))
        q = [filled(c, violated.shape) for c in given]
        chosen = self.violated_choice[k, self.whole_grid.nearest(q)].astype(np.int64)
        values = (
            self.safe_values[k, :, price],
            self.violated_values[k],
            float(self.prices[self.of_policies[price]]),
        )
        safe = np.flatnonzero(~violated)
        near = self.step.near_edge([c[safe] for c in q]) if safe.size else np.zeros(0, bool)
        for is_near in (False, True):
            rows = safe[near == is_near]
            if not rows.size:
                continue
            own = [c[rows] for c in q]
            grids = (self.safe_grid, self.known, self.whole_grid)
            gain = self.step.expected(own, is_near, *grids, values) + self.step.rewards(own, k)
            chosen[rows] = gain.argmax(axis=0)
        return self.inputs[chosen]
