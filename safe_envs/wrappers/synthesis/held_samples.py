"""Steps of the env at states, and the states at which a barrier for held input is looked at."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from safe_envs.dynamics.codegen import compile_function
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.certificates.certificate import Plant
from safe_envs.wrappers.synthesis.basis import ChebyshevBasis
from safe_envs.wrappers.synthesis.domain import Domain, at_states

_DEVIATIONS = 9.0
"""How far the noise of a step is followed, in standard deviations."""

_POOL, _BORDER, _HALVINGS = 30_000, 250, 45
_WIDENED = 1.005


@dataclass(frozen=True, eq=False)
class SampledStep:
    """One step of the env at states, for one input.

    Attributes:
        plant: the system, without a policy.
        period: control period in s.

    Raises:
        ConfigurationError: There is not one input, or one noise acts on several states.
    """

    plant: Plant
    period: float

    def __post_init__(self) -> None:
        count, rows = len(self.plant.inputs), self.plant.diffusion
        if count != 1:
            raise ConfigurationError(
                f"the system has {count} inputs; a barrier for held input is looked for with one"
                " input. Leave --held out"
            )
        if any(sum(entry != 0 for entry in column) > 1 for column in zip(*rows, strict=True)):
            raise ConfigurationError(
                "the same noise acts on several states; a barrier for held input is looked for"
                " where each noise acts on one state. Leave --held out"
            )

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """The bounds of the input."""
        ((low, high),) = self.plant.bounds
        return float(low), float(high)

    @cached_property
    def _functions(self) -> tuple:
        p = self.plant
        variances = [sum(e**2 for e in row) for row in p.diffusion]
        parts = (p.drift, [row[0] for row in p.input_matrix], variances)
        return tuple(compile_function(p.states, tuple(part), "arrays") for part in parts)

    def effect(self, x: np.ndarray) -> np.ndarray:
        """Return g at states (B, n), shape (B, n)."""
        return at_states(self._functions[1], x)

    def means(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the mean of X'.

        Args:
            x: states, shape (B, n).
            u: inputs, shape (B,).

        Returns:
            Shape (B, n).
        """
        return x + self.period * (at_states(self._functions[0], x) + self.effect(x) * u[:, None])

    def deviations(self, x: np.ndarray) -> np.ndarray:
        """Return the standard deviations of X' at states (B, n), shape (B, n)."""
        return np.sqrt(self.period * at_states(self._functions[2], x))

    def expected(self, basis: ChebyshevBasis, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the expectations of the members of a basis after a step, exactly.

        Args:
            basis: of polynomials.
            x: states, shape (B, n).
            u: inputs, shape (B,).

        Returns:
            Shape (B, K).
        """
        nodes, weights = np.polynomial.hermite_e.hermegauss(basis.degree // 2 + 1)
        weights = weights / weights.sum()
        mean, spread = self.means(x, u), self.deviations(x)
        found = np.ones((len(x), len(basis.exponents)))
        for i in range(x.shape[1]):
            moved = mean[:, i, None] + spread[:, i, None] * nodes
            z = (moved - float(basis.center[i])) / float(basis.scale[i])
            along = np.polynomial.chebyshev.chebvander(z, basis.degree)
            found *= np.einsum("bqk,q->bk", along, weights)[:, basis.exponents[:, i]]
        return found

    def frame(self, domain: Domain) -> tuple[tuple[Fraction, ...], tuple[Fraction, ...]]:
        """Return the center and half widths of a box that no step from C leaves, n of each.

        Args:
            domain: the safe set.
        """
        x = domain.bank
        spread = _DEVIATIONS * self.deviations(x)
        ends = [x]
        for u in self.bounds:
            mean = self.means(x, np.full(len(x), u))
            ends += [mean - spread, mean + spread]
        low, high = (np.min(ends, axis=(0, 1)), np.max(ends, axis=(0, 1)))
        if domain.even:
            high = np.maximum(high, -low)
            low = -high
        center, half = (low + high) / 2.0, _WIDENED * (high - low) / 2.0
        return (
            tuple(Fraction(f"{c:.6g}") for c in center.tolist()),
            tuple(Fraction(f"{r:.6g}") for r in half.tolist()),
        )


@dataclass(frozen=True, eq=False)
class StatePools:
    """States of the range of psi at which psi is looked at.

    Attributes:
        safe: of C inside the workspace, the ones next to its edge first, shape (B, n).
        unsafe: the others, the ones next to the edge first, shape (D, n).
        border: unsafe ones on the border of the range of psi and in its corners, shape (E, n).
        near: number of states next to the edge that both begin with.
    """

    safe: np.ndarray
    unsafe: np.ndarray
    border: np.ndarray
    near: int

    @classmethod
    def of(cls, domain: Domain, basis: ChebyshevBasis, rng: np.random.Generator) -> StatePools:
        """Return states of the range of a basis.

        Args:
            domain: the safe set.
            basis: whose scaled variables are in [-1, 1] there.
            rng: of the draws.
        """
        n = len(basis.states)
        center, half = (np.array(p, dtype=float) for p in (basis.center, basis.scale))
        box = center + half * (2.0 * rng.random((_POOL, n)) - 1.0)
        inside = domain.inside(box)
        safe, unsafe = np.concatenate([domain.bank, box[inside]]), box[~inside]
        corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * n), axis=-1).reshape(-1, n)
        faces = [corners]
        for i in range(n if n > 1 else 0):
            for end in (-1.0, 1.0):
                z = np.cos(np.pi * rng.random((_BORDER, n)))
                z[:, i] = end
                faces.append(z)
        border = center + half * np.concatenate(faces)
        border = border[~domain.inside(border)]
        unsafe = np.concatenate([unsafe, border])
        a = safe[rng.integers(len(safe), size=_POOL // 3)]
        b = unsafe[rng.integers(len(unsafe), size=_POOL // 3)]
        for _ in range(_HALVINGS):
            middle = (a + b) / 2.0
            within = domain.inside(middle)[:, None]
            a, b = np.where(within, middle, a), np.where(within, b, middle)
        layer = a + (safe.mean(axis=0) - a) * 0.15 * rng.random((len(a), 1)) ** 2
        safe = rng.permutation(np.concatenate([layer[domain.inside(layer)], safe]))
        unsafe = np.concatenate([b, rng.permutation(unsafe)])
        return cls(np.concatenate([a, safe]), unsafe, border, len(a))
