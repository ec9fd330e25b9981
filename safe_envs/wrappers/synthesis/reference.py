"""Inputs that a linear program takes as given, and where it asks for psi <= 0 instead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from safe_envs.wrappers.synthesis.basis import ChebyshevBasis
from safe_envs.wrappers.synthesis.candidate import BarrierCandidate
from safe_envs.wrappers.synthesis.domain import Domain
from safe_envs.wrappers.synthesis.generator import Generator, Samples
from safe_envs.wrappers.synthesis.witnesses import Witness
from safe_envs.wrappers.verification.search import towards_zero

_LEVELS = (-1.0, 0.0, 1.0)
"""Effects of an input for its band, at which states are taken along the sign change of L_g psi."""


class AskedClaims(NamedTuple):
    """What a linear program asks at states.

    Attributes:
        inputs: along which the generator inequality is asked, shape (B, m).
        generator: whether it is asked; where it is not, psi <= 0 is, shape (B,).
    """

    inputs: np.ndarray
    generator: np.ndarray

    def only(self, chosen: np.ndarray) -> AskedClaims:
        """Return what is asked at the states that a mask or indices choose."""
        return AskedClaims(self.inputs[chosen], self.generator[chosen])

    def joined(self, other: AskedClaims) -> AskedClaims:
        """Return what is asked at the states of both."""
        return AskedClaims(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


@dataclass(frozen=True, eq=False)
class Reference:
    """What fixes the inputs of a linear program: a law, or a barrier that they raise.

    The inequality with the best input for each psi is not convex in psi. With the best input for
    the last psi it is, and the last psi still meets it.

    Attributes:
        generator: of the plant.
        domain: the safe set.
        given: the law, or the barrier.
        band: see `Generator.best_inputs`, in 1/s.
    """

    generator: Generator
    domain: Domain
    given: Witness | BarrierCandidate
    band: float

    def asked(self, basis: ChebyshevBasis, samples: Samples) -> AskedClaims:
        """Return what is asked at states.

        Args:
            basis: of the samples.
            samples: states.
        """
        old = self.given
        if not isinstance(old, BarrierCandidate):
            return AskedClaims(old(samples.states), np.ones(len(samples.states), dtype=bool))
        if basis != old.basis:
            samples = self.generator.samples(old.basis, samples.states)
        psi = samples.values @ old.coefficients
        rate = self.generator.largest_rate(samples, old.coefficients)
        met = rate + old.bound.rate * psi + old.shortfall >= 0.0
        inputs = self.generator.best_inputs(samples, old.coefficients, self.band)
        return AskedClaims(inputs, (psi > 0.0) | met)

    def sign_changes(self, states: np.ndarray) -> np.ndarray:
        """Return states of G near those where an input changes its sign; none for a law.

        The given inputs vary most there, so that more states are needed.

        Args:
            states: of C, to begin at, shape (B, n).
        """
        old, found = self.given, [states[:0]]
        if not isinstance(old, BarrierCandidate):
            return found[0]
        c, half = old.coefficients, np.diff(self.generator.bounds, axis=1)[:, 0] / 2.0
        near = self.generator.samples(old.basis, states)
        near = near.only(near.values @ c > 0.0)
        cells = self.domain.cells(near.states, 10 * len(c))
        for j, h in enumerate(half):
            effect = np.abs(near.inputs[:, j] @ c)
            counts = np.zeros(len(effect), dtype=bool)
            counts[np.argsort(effect)[: 100 + 10 * len(c)]] = True
            begin = near.states[worst(-effect, cells, counts, 100 + 3 * len(c))]
            for level in _LEVELS if len(begin) else ():

                def distance(x: np.ndarray, j: int = j, e: float = level / h) -> np.ndarray:
                    own = self.generator.samples(old.basis, x).inputs[:, [j]]
                    return own @ c - e * self.band

                moved = towards_zero(distance, begin, self.domain.region)
                found.append(moved[self.domain.inside(moved)])
        return np.concatenate(found)


def worst(cost: np.ndarray, cell: np.ndarray, counts: np.ndarray, most: int) -> np.ndarray:
    """Return indices of the largest costs, one of each cell, of those that count.

    Args:
        cost: shape (B,).
        cell: number of the cell of each, shape (B,).
        counts: shape (B,).
        most: number of indices.
    """
    order = np.flatnonzero(counts)
    order = order[np.argsort(-cost[order], kind="stable")]
    _, first = np.unique(cell[order], return_index=True)
    return order[np.sort(first)][:most]
