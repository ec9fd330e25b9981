"""Whether a certificate is of a given system and problem, in exact numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.certificates.certificate import Plant

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
    sigma: Any = sp.Matrix(plant.diffusion)
    # A product of decimals is exact only after they are rationals.
    drift, effect, spread = (
        sp.Matrix(part).applyfunc(lambda e: _exact(system, e))
        for part in (system.drift, system.input_matrix, system.diffusion)
    )
    parts = (
        ("the drift", sp.Matrix(plant.drift), drift),
        ("the effect of the inputs", sp.Matrix(plant.input_matrix), effect),
        ("the noise", sigma * sigma.T, spread * spread.T),
    )
    return [name for name, known, given in parts if not _equal(known.tolist(), given.tolist())]


def problem_differences(plant: Plant, problem: SafetyProblem) -> list[str]:
    """Return in what a problem differs from that of a certificate, apart from its system.

    Args:
        plant: of the certificate.
        problem: with its states, inputs and barriers.
    """
    if (plant.states, plant.inputs) != (problem.plant.states, problem.plant.inputs):
        return [_symbols(plant, problem.plant)]
    barriers = [_exact(problem.plant, b.expression) for b in problem.barriers]
    differing = [
        f"the workspace of {v.symbol}"
        for v, ends in zip(problem.states, plant.workspace, strict=True)
        if not (_same_ends(ends, v.low, v.high) or (is_one_period(ends) and np.isinf(v.high)))
    ]
    differing += [
        f"the bounds of {v.symbol}"
        for v, ends in zip(problem.inputs, plant.bounds, strict=True)
        if not _same_ends(ends, v.low, v.high)
    ]
    return differing + ["the barriers"] * (not _equal(plant.barriers, barriers))


def is_among(known: Sequence[sp.Expr], given: sp.Expr) -> bool:
    """Return whether an exact expression equals one of several.

    Args:
        known: the several.
        given: the one.
    """
    return any(_equal([each], [given]) for each in known)


def _exact(system: ControlAffineSDE, expression: Any) -> Any:
    """Return an expression with decimals as rationals, those of the parameters too."""
    found = system.exact(expression)
    return found.xreplace({f: sp.Rational(repr(float(f))) for f in found.atoms(sp.Float)})


def _symbols(plant: Plant, system: ControlAffineSDE) -> str:
    known, given = (", ".join(map(str, (*s.states, *s.inputs))) for s in (plant, system))
    return f"the states and inputs ({known} in place of {given})"


def _equal(known: Sequence[Any], given: Sequence[Any]) -> bool:
    """Return whether expressions, or lists of them, are equal one by one."""
    return len(known) == len(given) and all(
        _equal(a, b) if isinstance(a, list) else is_zero(a - b)
        for a, b in zip(known, given, strict=True)
    )


def _same_ends(ends: tuple[sp.Expr, sp.Expr], low: float, high: float) -> bool:
    """Return whether exact ends are those of a range, whose numbers are decimal or rounded."""
    return all(_same(exact, end) for exact, end in zip(ends, (low, high), strict=True))


def _same(exact: sp.Expr, given: float) -> bool:
    if exact.is_Rational:
        return np.isfinite(given) and exact == sp.Rational(repr(float(given)))
    return float(exact) == given
