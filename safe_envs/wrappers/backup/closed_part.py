"""The part of a system that plans need: the states on which barriers and backup laws depend."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE


def closed_part(
    system: ControlAffineSDE, expressions: Iterable[sp.Expr]
) -> tuple[ControlAffineSDE, tuple[int, ...]]:
    """Return the smallest part of a system that moves by itself and holds expressions.

    The position of a vehicle, say, need not be simulated where its altitude is to be kept.

    Args:
        system: whose states are looked at. With noise it is returned as it is, for the noise of
            one state decides how all are integrated.
        expressions: of the states.

    Returns:
        The part, and the indices of its states.
    """
    drift, effect = sp.Matrix(system.drift), sp.Matrix(system.input_matrix)
    both: Any = drift.row_join(effect).tolist()
    rates = [set[Any]().union(*(sp.sympify(e).free_symbols for e in row)) for row in both]
    needed: set[Any] = set().union(*(e.free_symbols for e in expressions))
    chosen: set[int] = set()
    while True:
        new = {i for i, s in enumerate(system.states) if s in needed} - chosen
        if not new:
            break
        chosen |= new
        needed = set().union(*(rates[i] for i in new))
    if system.noisy or not chosen or len(chosen) == system.n:
        return system, tuple(range(system.n))
    places = sorted(chosen)
    part = ControlAffineSDE(
        states=tuple(system.states[i] for i in places),
        inputs=system.inputs,
        drift=drift.extract(places, [0]),
        input_matrix=effect.extract(places, list(range(system.m))),
        diffusion=sp.zeros(len(places), 1),
        parameters=system.parameters,
    )
    return part, tuple(places)
