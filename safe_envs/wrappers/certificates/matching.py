"""Whether a certificate is of a given system and problem, in exact numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sympy as sp

from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.certificates.certificate import Plant
from safe_envs.wrappers.certificates.statements import exact_in, plant_of

PERIOD = 2 * sp.pi
"""Of an angle."""


def is_one_period(ends: tuple[sp.Expr, sp.Expr]) -> bool:
    """Return whether the ends of a state are those of one turn of an angle."""
    return ends[1] - ends[0] == PERIOD


def system_differences(plant: Plant, system: ControlAffineSDE) -> list[str]:
    """Return in what a system differs from that of a certificate, in words.

    Args:
        plant: of the certificate.
        system: with its parameters.
    """
    if (plant.states, plant.inputs) != (system.states, system.inputs):
        return [_symbols(plant, system)]
    drift, effect, sigma = (
        sp.Matrix(part).applyfunc(lambda e: exact_in(system, e))
        for part in (system.drift, system.input_matrix, system.diffusion)
    )
    # Noises with the same covariance are the same.
    known: Any = sp.Matrix(plant.diffusion)
    parts: Any = (
        ("the drift", plant.drift, drift),
        ("the effect of the inputs", sp.Matrix(plant.input_matrix), effect),
        ("the noise", known * known.T, sigma * sigma.T),
    )
    return [name for name, ours, theirs in parts if not _equal(list(ours), list(theirs))]


def problem_differences(plant: Plant, problem: SafetyProblem) -> list[str]:
    """Return in what a problem differs from that of a certificate, apart from its system.

    Args:
        plant: of the certificate.
        problem: with its states, inputs and barriers.

    Raises:
        ConfigurationError: No certificate can be of the problem; see `plant_of`.
    """
    if (plant.states, plant.inputs) != (problem.plant.states, problem.plant.inputs):
        return [_symbols(plant, problem.plant)]
    given = plant_of(problem)
    ranges = [
        *zip(plant.states, plant.workspace, given.workspace, strict=True),
        *zip(plant.inputs, plant.bounds, given.bounds, strict=True),
    ]
    differing = [
        f"the {'workspace' if symbol in plant.states else 'bounds'} of {symbol}"
        for symbol, ours, theirs in ranges
        if not _equal(ours, theirs)
    ]
    return differing + ["the barriers"] * (not _equal(plant.barriers, given.barriers))


def is_among(known: Sequence[sp.Expr], given: sp.Expr) -> bool:
    """Return whether an exact expression equals one of several.

    Args:
        known: the several.
        given: the one.
    """
    return any(_equal([each], [given]) for each in known)


def _symbols(plant: Plant, system: ControlAffineSDE) -> str:
    known, given = (", ".join(map(str, (*s.states, *s.inputs))) for s in (plant, system))
    return f"the states and inputs ({known} in place of {given})"


def _equal(known: Sequence[Any], given: Sequence[Any]) -> bool:
    return len(known) == len(given) and all(
        is_zero(a - b) for a, b in zip(known, given, strict=True)
    )
