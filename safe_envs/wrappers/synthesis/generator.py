"""The generator of a plant on a basis: the numbers of the linear programs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.errors import NumericalError
from safe_envs.wrappers.certificates.certificate import Plant
from safe_envs.wrappers.synthesis.basis import ChebyshevBasis
from safe_envs.wrappers.synthesis.domain import at_states


@dataclass(frozen=True)
class Samples:
    """States with the values of a basis and of its generator.

    Attributes:
        states: shape (B, n).
        values: of the members of the basis, shape (B, K).
        drift: L_f phi + 1/2 tr(sigma' D2phi sigma) of each member phi; along the policy where
            there is one, shape (B, K).
        inputs: L_g phi; of no input where there is a policy, shape (B, m, K).
    """

    states: np.ndarray
    values: np.ndarray
    drift: np.ndarray
    inputs: np.ndarray

    def joined(self, other: Samples) -> Samples:
        """Return the states of both."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Samples(*(np.concatenate(pair) for pair in pairs))

    def only(self, chosen: np.ndarray) -> Samples:
        """Return the states that a mask or indices choose."""
        return Samples(*(part[chosen] for part in vars(self).values()))

    def along(self, inputs: np.ndarray) -> np.ndarray:
        """Return the generator of each member along inputs (B, m), shape (B, K)."""
        return self.drift + np.einsum("bm,bmk->bk", inputs, self.inputs)


@dataclass(frozen=True)
class Generator:
    """Lie derivatives and Ito corrections at states.

    Attributes:
        plant: the system.
    """

    plant: Plant

    @cached_property
    def bounds(self) -> np.ndarray:
        """Lower and upper bounds of the inputs, shape (m, 2); of none where there is a policy."""
        if self.plant.policy:
            return np.zeros((0, 2))
        return np.array([[float(e) for e in pair] for pair in self.plant.bounds]).reshape(-1, 2)

    @cached_property
    def _parts(self) -> tuple[Any, Any, Any]:
        p = self.plant
        drift, effect = sp.Matrix(p.drift), sp.Matrix(p.input_matrix)
        if p.policy:
            drift, effect = drift + effect * sp.Matrix(p.policy), sp.zeros(len(p.states), 0)
        sigma = sp.Matrix(p.diffusion) if p.diffusion[0] else sp.zeros(len(p.states), 1)
        return (
            compile_function(p.states, drift.flat(), "arrays"),
            compile_function(p.states, effect.flat(), "arrays") if len(effect) else None,
            compile_function(p.states, (sigma * sigma.T).flat(), "arrays"),
        )

    def fields(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return drift (B, n), input matrix (B, n, m) and sigma sigma' (B, n, n) at states (B, n).

        Raises:
            NumericalError: One of them has no finite value at a state.
        """
        n = x.shape[1]
        drift, effect, covariance = self._parts
        with np.errstate(all="ignore"):
            found = (
                at_states(drift, x),
                at_states(effect, x).reshape(len(x), n, len(self.bounds))
                if effect is not None
                else np.zeros((len(x), n, 0)),
                at_states(covariance, x).reshape(len(x), n, n),
            )
        for part in found:
            bad = ~np.isfinite(part).all(axis=tuple(range(1, part.ndim)))
            if bad.any():
                raise NumericalError(
                    "the system has no finite drift, input matrix or diffusion at the state"
                    f" {x[bad][0].tolist()} of the safe set"
                )
        return found

    def samples(self, basis: ChebyshevBasis, x: np.ndarray) -> Samples:
        """Return a basis and its generator at states.

        Args:
            basis: whose members are taken.
            x: states, shape (B, n).
        """
        drift, effect, covariance = self.fields(x)
        jets = basis.jets(x)
        rates = np.einsum("bn,bnk->bk", drift, jets.gradients)
        rates += 0.5 * np.einsum("bij,bijk->bk", covariance, jets.hessians)
        return Samples(x, jets.values, rates, np.einsum("bnm,bnk->bmk", effect, jets.gradients))

    def largest_rate(self, samples: Samples, coefficients: np.ndarray) -> np.ndarray:
        """Return the largest A psi along inputs within the bounds, shape (B,).

        Args:
            samples: states, B of them.
            coefficients: of psi.
        """
        effect = samples.inputs @ coefficients
        low, high = self.bounds.T
        return samples.drift @ coefficients + np.maximum(low * effect, high * effect).sum(axis=1)

    def best_inputs(self, samples: Samples, coefficients: np.ndarray, band: float) -> np.ndarray:
        """Return inputs within the bounds that raise psi most, or nearly.

        They are continuous: inputs that jump where L_g psi changes its sign let a linear program
        move that change between the sampled states, where its inequality fails then.

        Args:
            samples: states, B of them.
            coefficients: of psi.
            band: effect of an input on the rate of psi, in 1/s, below which it is in proportion to
                the effect: a quarter of it is lost at most.

        Returns:
            Shape (B, m).
        """
        low, high = self.bounds.T
        half = (high - low) / 2.0
        effect = samples.inputs @ coefficients
        return (low + high) / 2.0 + half * np.clip(effect * half / band, -1.0, 1.0)
