"""Inputs within the bounds for which the first linear program asks the generator inequality."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.errors import SystemDefinitionError
from safe_envs.wrappers.certificates.certificate import Plant
from safe_envs.wrappers.synthesis.domain import Domain, at_states
from safe_envs.wrappers.synthesis.generator import Generator

Witness = Callable[[np.ndarray], np.ndarray]
"""From states (B, n) to inputs (B, m)."""


def witnesses_of(
    generator: Generator, domain: Domain, nominal: tuple[sp.Expr, ...]
) -> dict[str, Witness]:
    """Return inputs to begin with, by name: the better of them is found by trying.

    Args:
        generator: of the plant.
        domain: the safe set.
        nominal: laws of the nominal controller, of the states; () where it is none.

    Returns:
        The input that raises the smallest h fastest, where that has relative degree 1; a linear
        feedback that holds the plant at the state with the largest h; the nominal controller; the
        middle of the bounds. Just one for a plant without a free input.
    """
    middle = generator.bounds.mean(axis=1)
    found: dict[str, Witness] = {}
    if len(middle):
        found["ascent of h"] = _ascent(generator, domain)
        regulator = _regulator(generator, domain)
        if regulator is not None:
            found["linear regulator"] = regulator
        if nominal:
            found["nominal controller"] = _law(generator, domain.plant, nominal)
    return found | {"constant input": lambda x: np.broadcast_to(middle, (len(x), len(middle)))}


def _law(generator: Generator, plant: Plant, laws: tuple[sp.Expr, ...]) -> Witness:
    compiled = compile_function(plant.states, laws, "arrays")
    low, high = generator.bounds.T

    def inputs(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            values = at_states(compiled, x)
        return np.where(np.isfinite(values), values, (low + high) / 2.0).clip(low, high)

    return inputs


def _ascent(generator: Generator, domain: Domain) -> Witness:
    plant = domain.plant
    levels = compile_function(plant.states, plant.barriers, "arrays")
    slopes = compile_function(
        plant.states, [sp.diff(h, s) for h in plant.barriers for s in plant.states], "arrays"
    )
    low, high = generator.bounds.T

    def inputs(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            gradients = at_states(slopes, x).reshape(len(x), len(plant.barriers), -1)
            nearest = at_states(levels, x).argmin(axis=1)
        gradient = np.nan_to_num(gradients[np.arange(len(x)), nearest])
        effect = np.einsum("bn,bnm->bm", gradient, generator.fields(x)[1])
        return np.where(effect > 0.0, high, np.where(effect < 0.0, low, (low + high) / 2.0))

    return inputs


def _regulator(generator: Generator, domain: Domain) -> Witness | None:
    """Return u_0 - K (x - x_0), clipped, or nothing where the plant cannot be stabilised so."""
    from scipy.linalg import LinAlgError, solve_continuous_are

    plant = domain.plant
    best = domain.bank[domain.level(domain.bank).argmax()]
    scale = np.array([float(s) for s in domain.frame[1]])
    half = np.diff(generator.bounds, axis=1)[:, 0] / 2.0
    drift, effect, _ = generator.fields(best[None])
    b = effect[0] * half / scale[:, None]
    try:
        jacobian = sp.Matrix(plant.drift).jacobian(list(plant.states))
        slopes = at_states(compile_function(plant.states, jacobian.flat(), "arrays"), best[None])
        a = slopes.reshape(len(scale), -1) * scale / scale[:, None]
        cost = solve_continuous_are(a, b, np.eye(len(scale)), np.eye(len(half)))
    except (LinAlgError, ValueError, SystemDefinitionError):
        return None
    gain = half[:, None] * (b.T @ cost) / scale
    low, high = generator.bounds.T
    holding = np.linalg.lstsq(effect[0], -drift[0], rcond=None)[0].clip(low, high)
    return lambda x: (holding - (x - best) @ gain.T).clip(low, high)
