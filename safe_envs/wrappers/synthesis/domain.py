"""Where the statements about a barrier have to hold: states of C, and of its edge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.certificates.certificate import Plant
from safe_envs.wrappers.verification.safe_set import sample
from safe_envs.wrappers.verification.search import Region

_BANK = 2**14
_WIDENED = 1.02
_HALVINGS = 45
_DECIMALS = 3


@dataclass(frozen=True)
class Domain:
    """The safe set C within a workspace, from which states are drawn.

    Attributes:
        plant: the system.
        low: lower ends of the workspace, shape (n,).
        high: upper ends, shape (n,).
        closed: states at whose ends no episode ends, so that psi has to be <= 0 there: those of
            which the workspace holds one period, shape (n,).
        seed: of the draws that find C.

    Raises:
        ConfigurationError: No state of C was found, or the workspace is unbounded.
    """

    plant: Plant
    low: np.ndarray
    high: np.ndarray
    closed: np.ndarray
    seed: int = 0

    @classmethod
    def of(cls, plant: Plant, closed: Sequence[bool], seed: int = 0) -> Domain:
        """Return the domain of a plant.

        Args:
            plant: the system.
            closed: see the class.
            seed: see the class.

        Raises:
            ConfigurationError: See the class.
        """
        ends = np.array([[float(e) for e in pair] for pair in plant.workspace])
        unbounded = [
            str(s) for s, own in zip(plant.states, ends, strict=True) if not np.isfinite(own).all()
        ]
        if unbounded:
            raise ConfigurationError(
                f"the workspace is unbounded in {', '.join(unbounded)}, where no polynomial is"
                " bounded; give the states a finite range"
            )
        return cls(plant, ends[:, 0], ends[:, 1], np.array(closed, dtype=bool), seed)

    @property
    def region(self) -> Region:
        """The workspace."""
        none = np.zeros(len(self.low), dtype=bool)
        return Region(self.low, self.high, none, none)

    @cached_property
    def bank(self) -> np.ndarray:
        """States that fill C, shape (B, n)."""
        rng = np.random.default_rng(self.seed)
        found = sample("the safe set", self.level, self.region, _BANK, rng).points
        return found[self.inside(found)]

    @cached_property
    def frame(self) -> tuple[tuple[Fraction, ...], tuple[Fraction, ...]]:
        """Center and half widths of a box around C, in short decimals, n of each."""
        low, high = self.bank.min(axis=0), self.bank.max(axis=0)
        if self.even:
            high = np.maximum(high, -low)
            low = -high
        center, half = (low + high) / 2.0, _WIDENED * (high - low) / 2.0
        low, high = np.maximum(self.low, center - half), np.minimum(self.high, center + half)
        return (
            tuple(_decimal(c, round) for c in (low + high) / 2.0),
            tuple(_decimal(r, np.ceil) for r in (high - low) / 2.0),
        )

    @cached_property
    def even(self) -> bool:
        """Whether all is the same at x and -x, so that psi may be: with the inputs u or -u."""
        p = self.plant
        mirrored = {s: -s for s in p.states}
        ends = [(*p.workspace,), (*p.bounds,)]
        if any(low + high != 0 for low, high in ends[0]) or p.policy or self.closed.any():
            return False

        def parity(entries: Any) -> int:
            """Return 1 for even entries, -1 for odd ones, 0 for others."""
            for sign in (1, -1):
                if all(sp.expand(e.subs(mirrored) - sign * e) == 0 for e in entries):
                    return sign
            return 0

        symmetric = all(low + high == 0 for low, high in ends[1])
        sigma = sp.Matrix(p.diffusion)
        effects = [parity(column) for column in zip(*p.input_matrix, strict=True)]
        return (
            all(parity([h]) == 1 for h in p.barriers)
            and all(e.subs(mirrored) + e == 0 for e in map(sp.expand, p.drift))
            and parity(sigma * sigma.T) == 1
            and all(e == -1 or (e == 1 and symmetric) for e in effects)
        )

    @cached_property
    def _barriers(self) -> Any:
        return compile_function(self.plant.states, self.plant.barriers, "arrays")

    def level(self, x: np.ndarray) -> np.ndarray:
        """Return the smallest h of states (B, n), shape (B,)."""
        with np.errstate(all="ignore"):
            return at_states(self._barriers, x).min(axis=1)

    def inside(self, x: np.ndarray) -> np.ndarray:
        """Return which states (B, n) are in C and in the workspace, shape (B,)."""
        within = ((x >= self.low) & (x <= self.high)).all(axis=1)
        return within & (self.level(x) >= 0.0)

    def wrapped(self, x: np.ndarray) -> np.ndarray:
        """Return states (B, n) whose angles are in the one period that the workspace holds."""
        period = self.high - self.low
        return np.where(self.closed, self.low + (x - self.low) % period, x)

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw states of C, more of them near its edge.

        Args:
            count: of draws, some of which may be outside.
            rng: of the draws.

        Returns:
            Shape (B, n), B <= count.
        """
        x, end, _ = self._rays(count, rng)
        share = 1.0 - rng.random(len(x)) ** 2
        found = x + share[:, None] * (end - x)
        return found[self.inside(found)]

    def draw_edge(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw states of C where an h is 0, or at an end where no episode ends.

        Args:
            count: of draws, some of which may leave the workspace instead.
            rng: of the draws.

        Returns:
            Shape (B, n).
        """
        _, end, leaves = self._rays(count, rng)
        found = [end[leaves]]
        for i in np.flatnonzero(self.closed).tolist():
            for value in (self.low[i], self.high[i]):
                moved = self.bank[rng.integers(len(self.bank), size=count // 2)].copy()
                moved[:, i] = value
                found.append(moved[self.inside(moved)])
        return np.concatenate(found)

    def cells(self, x: np.ndarray, count: int) -> np.ndarray:
        """Return the number of the cell in which each state is.

        Args:
            x: states, shape (B, n).
            count: of cells, about.

        Returns:
            Shape (B,).
        """
        n = x.shape[1]
        center, scale = (np.array([float(v) for v in part]) for part in self.frame)
        along = math.ceil(count ** (1.0 / n))
        place = (((x - center) / scale + 1.0) / 2.0 * along).astype(int).clip(0, along - 1)
        return np.asarray(np.ravel_multi_index(tuple(place.T), (along,) * n))

    def _rays(
        self, count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return starts of rays in C, where they leave it, and which do so within the workspace."""
        x = self.bank[rng.integers(len(self.bank), size=count)]
        direction = rng.standard_normal(x.shape) * np.array([float(s) for s in self.frame[1]])
        # A quarter of the rays lies in the ends of the workspace, where a polynomial may be large.
        i, upper = rng.integers(x.shape[1], size=count), rng.random(count) < 0.5
        moved, each = x.copy(), np.arange(count)
        moved[each, i] = np.where(upper, self.high[i], self.low[i])
        ends = (rng.random(count) < 0.25) & self.inside(moved) & (x.shape[1] > 1)
        x = np.where(ends[:, None], moved, x)
        direction[each[ends], i[ends]] = 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            ahead = np.where(direction > 0.0, self.high - x, self.low - x) / direction
        longest = np.nanmin(np.where(direction == 0.0, np.inf, ahead), axis=1)
        leaves = self.level(x + longest[:, None] * direction) < 0.0
        low, high = np.where(leaves, 0.0, longest), longest.copy()
        for _ in range(_HALVINGS):
            middle = (low + high) / 2.0
            within = self.level(x + middle[:, None] * direction) >= 0.0
            low, high = np.where(within, middle, low), np.where(within, high, middle)
        return x, x + low[:, None] * direction, leaves


def at_states(function: Any, x: np.ndarray) -> np.ndarray:
    """Return what a compiled function gives at states.

    Args:
        function: of the components of a state.
        x: states, shape (B, n).

    Returns:
        Shape (B, number of expressions).
    """
    parts = function(*np.ascontiguousarray(x.T))
    return np.stack([np.broadcast_to(np.asarray(p, dtype=float), len(x)) for p in parts], axis=1)


def _decimal(value: float, rounding: Any) -> Fraction:
    """Return a number near a value, with few decimals for its size."""
    power = _DECIMALS - int(np.floor(np.log10(abs(value)))) if value else 0
    unit = Fraction(10) ** -power
    return Fraction(int(rounding(value / float(unit)))) * unit
