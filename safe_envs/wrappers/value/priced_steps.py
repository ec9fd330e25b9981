"""One control period from the nodes of a grid, as sparse matrices of the values that it reaches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import compile_function, filled
from safe_envs.errors import ConfigurationError
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.value.interpolation import Points, weighted_matrix, weighted_means
from safe_envs.wrappers.value.node_grid import NodeGrid
from safe_envs.wrappers.value.noise_rules import NoiseRule, edge_rule, smooth_rule
from safe_envs.wrappers.value.rewarded import RewardedProblem

_FAR = 5.5
"""Standard deviations of noise that must not reach an edge where few nodes are to suffice."""


@dataclass(frozen=True)
class Sides:
    """On which side of the edges points, or the boxes around them, lie: shares in [0, 1].

    Attributes:
        safe: within all barriers, and within the workspace if leaving it is a violation.
        going: where the episode goes on.
    """

    safe: np.ndarray
    going: np.ndarray


@dataclass(frozen=True, eq=False)
class Steps:
    """A control period from some nodes under each input; one entry for each input and node.

    Attributes:
        reward: expected reward, shape (U, nodes).
        exits: chance to become unsafe, shape (U, nodes).
        safe: takes values of the nodes of the safe part, (U nodes, values) sparse.
        violated: takes values of the nodes of the workspace; None where nothing reaches them.
    """

    reward: np.ndarray
    exits: np.ndarray
    safe: Any
    violated: Any


@dataclass(frozen=True, eq=False)
class _Moves:
    """Where a control period leads: points, arrays (U, B, W), and their weights.

    Attributes:
        reached: the points.
        staying: weights of what goes on safely.
        lost: weights of what goes on after a violation.
        exits: chance of a violation, shape (U, B).
    """

    reached: Points
    staying: np.ndarray
    lost: np.ndarray
    exits: np.ndarray


class PricedStep:
    """A control period of a problem with a reward.

    Args:
        given: the problem.
        inputs: that are tried, shape (U, m).
        leaving: how leaving the workspace counts, see `ValueSettings`.
    """

    def __init__(self, given: RewardedProblem, inputs: np.ndarray, leaving: str) -> None:
        small = self._small = given.small
        self._inputs, self._stays = inputs, leaving == "violation"
        coordinates = small.symbols
        self._step = compile_function(
            (*coordinates, *small.inputs, *small.noise), small.step, "arrays"
        )
        goal = -1 if small.goal is None else small.goal
        self._sets = compile_function(coordinates, (*small.barriers, small.outside, goal), "arrays")
        self._reward = compile_function(
            (*coordinates, *small.inputs, TIME), (given.reward,), "arrays"
        )
        normals = len(small.noise) * small.substeps
        self._smooth, self._edge = smooth_rule(normals), edge_rule(normals)
        far = _FAR * np.eye(normals)
        nodes = np.concatenate([np.zeros((normals, 1)), far, -far], axis=1)
        self._reach = NoiseRule(nodes, np.ones(nodes.shape[1]), 0.0)

    def is_safe(self, q: Points) -> np.ndarray:
        """Return whether points are safe, for points of any shape."""
        safe, _ = self._margins(q)
        return np.all(safe, axis=0)

    def near_edge(self, q: Points) -> np.ndarray:
        """Return from which points noise may pass an edge within a period, shape (B,)."""
        margins = self._all_margins(self._reached(q, self._reach.nodes))
        return ~np.all([m > 0.0 for m in margins], axis=(0, 1, 3))

    def rewards(self, q: Points, k: int) -> np.ndarray:
        """Return the expected rewards of a period, shape (U, B).

        Args:
            q: points, arrays (B,).
            k: number of the period.

        Raises:
            ConfigurationError: A reward is not finite.
        """
        reached = self._reached(q, self._smooth.nodes)
        u = [each[:, None, None] for each in self._inputs.T]
        time = (k + 1) * self._small.problem.dt
        with np.errstate(all="ignore"):
            found = filled(self._reward(*reached, *u, time)[0], reached[0].shape)
        found = found @ self._smooth.weights
        if not np.isfinite(found).all():
            raise ConfigurationError(
                f"the reward of {self._small.problem.name} is not finite everywhere in its"
                " workspace"
            )
        return found

    def steps(
        self,
        q: Points,
        near: bool,
        safe_grid: NodeGrid,
        known: np.ndarray,
        whole_grid: NodeGrid,
    ) -> Steps:
        """Return a control period from safe points.

        Args:
            q: the points, arrays (B,).
            near: whether noise may pass an edge.
            safe_grid: nodes of values that are still safe.
            known: place of each of its nodes in these values, -1 for none.
            whole_grid: nodes of the values after a violation.
        """
        moves = self._moves(q, near)
        return Steps(
            self.rewards(q, 0),
            moves.exits,
            weighted_matrix(safe_grid, moves.reached, moves.staying, known),
            weighted_matrix(whole_grid, moves.reached, moves.lost, None) if near else None,
        )

    def expected(
        self,
        q: Points,
        near: bool,
        safe_grid: NodeGrid,
        known: np.ndarray,
        whole_grid: NodeGrid,
        values: tuple[np.ndarray, np.ndarray, float],
    ) -> np.ndarray:
        """Return the expected value of the next states, less the price, shape (U, B).

        Args:
            q: safe points, arrays (B,).
            near: see `steps`, as for the grids.
            safe_grid: see there.
            known: see there.
            whole_grid: see there.
            values: of the safe nodes, of the nodes of the workspace, and the price.
        """
        moves = self._moves(q, near)
        safe, after, price = values
        table = np.where(known >= 0, safe[np.maximum(known, 0)], np.nan)
        found = weighted_means(safe_grid, moves.reached, moves.staying, table)
        if near:
            found += weighted_means(whole_grid, moves.reached, moves.lost, after)
        return found - price * moves.exits

    def _moves(self, q: Points, near: bool) -> _Moves:
        rule = self._edge if near else self._smooth
        reached = self._reached(q, rule.nodes)
        if not near:
            shape = reached[0].shape
            none = np.zeros(shape[:2])
            return _Moves(reached, np.broadcast_to(rule.weights, shape), none, none)
        sides = self._sides(q, reached, rule)
        return _Moves(
            reached,
            rule.weights * np.minimum(sides.safe, sides.going),
            rule.weights * np.maximum(sides.going - sides.safe, 0.0),
            (1.0 - sides.safe) @ rule.weights,
        )

    def violated_steps(self, q: Points, whole_grid: NodeGrid) -> Steps:
        """Return a control period after a violation.

        Args:
            q: points, arrays (B,).
            whole_grid: nodes of the values after a violation.
        """
        rule = self._smooth
        reached = self._reached(q, rule.nodes)
        _, going = self._margins(reached)
        weights = rule.weights * np.all(going, axis=0)
        return Steps(
            self.rewards(q, 0),
            np.zeros((len(self._inputs), len(q[0]))),
            None,
            weighted_matrix(whole_grid, reached, weights, None),
        )

    def _reached(self, q: Points, noise: np.ndarray) -> Points:
        """Return where points go under all inputs and noises, arrays (U, B, W)."""
        small = self._small
        shape = (len(self._inputs), len(q[0]), noise.shape[1])
        x = [each[None, :, None] for each in q]
        u = [each[:, None, None] for each in self._inputs.T]
        with np.errstate(all="ignore"):
            for draws in np.split(noise, small.substeps):
                x = self._step(*x, *u, *(w[None, None] for w in draws))
        return [filled(each, shape) for each in x]

    def _margins(self, x: Points) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return which barriers are positive at points, and which ends have not come."""
        *barriers, left, goal = self._values(x)
        safe, inside = [h > 0.0 for h in barriers], left <= 0.0
        return safe + [inside] * self._stays, [inside, goal < 0.0]

    def _values(self, x: Points) -> list[np.ndarray]:
        with np.errstate(all="ignore"):
            return [filled(v, x[0].shape) for v in self._sets(*x)]

    def _all_margins(self, x: Points) -> list[np.ndarray]:
        *barriers, left, goal = self._values(x)
        return [*barriers, -left, -goal]

    def _sides(self, q: Points, reached: Points, rule: NoiseRule) -> Sides:
        if not rule.width:
            safe, going = self._margins(reached)
            return Sides(
                np.all(safe, axis=0).astype(np.float64), np.all(going, axis=0).astype(np.float64)
            )
        spreads: Any = 0.0
        for axis in np.eye(len(rule.nodes)):
            half = 0.5 * rule.width * axis[:, None]
            ends = [self._all_margins(self._reached(q, s * half)) for s in (1, -1)]
            spreads = spreads + np.abs(np.array(ends[0]) - np.array(ends[1]))
        shares = []
        for margin, spread in zip(self._all_margins(reached), spreads, strict=True):
            with np.errstate(all="ignore"):
                share = np.clip(0.5 + margin / spread, 0.0, 1.0)
            shares.append(np.where(spread > 0.0, share, margin > 0.0))
        *barriers, inside, unfinished = shares
        safe: Any = np.min([*barriers, *[inside] * self._stays], axis=0)
        return Sides(safe, np.minimum(inside, unfinished))
