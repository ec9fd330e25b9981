"""Checks of barrier arguments, and building blocks of start distributions."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.problem.starts import Start
from safe_envs.text import finite_number


def positive(name: str, value: float) -> float:
    """Return a barrier's argument as a float.

    Args:
        name: of the argument, for errors.
        value: what was given.

    Raises:
        ConfigurationError: it is not a positive finite number.
    """
    number = finite_number(name, value)
    if not number > 0:
        raise ConfigurationError(f"{name} = {number}; give a positive number")
    return number


def uniforms(count: int) -> tuple[sp.Symbol, ...]:
    """Return symbols of independent uniforms on [0, 1)."""
    return sp.symbols(f"uniform_1:{count + 1}", real=True)


def around(center: float, half_width: float, uniform: sp.Symbol) -> sp.Expr:
    """Return the uniform on [center - half_width, center + half_width).

    Args:
        center: midpoint.
        half_width: distance from it to both ends.
        uniform: symbol of a uniform on [0, 1).
    """
    return center + half_width * (2 * uniform - 1)


def uniform_box(
    centers: Sequence[float], half_widths: Sequence[float], condition: sp.Expr | None = None
) -> Start:
    """Return the start that is uniform in a box of states.

    Args:
        centers: midpoint of each state.
        half_widths: distance from it to both ends; 0 fixes the state.
        condition: positive where a start is allowed.
    """
    free = uniforms(sum(half > 0 for half in half_widths))
    left = iter(free)
    pairs = zip(centers, half_widths, strict=True)
    state = tuple(around(c, half, next(left)) if half > 0 else sp.Float(c) for c, half in pairs)
    return Start(state, free, condition)


def in_disk(radius: float, area: sp.Symbol, angle: sp.Symbol) -> tuple[sp.Expr, sp.Expr]:
    """Return a uniform point of the disk around the origin, from two uniforms.

    Args:
        radius: of the disk.
        area: uniform that gives the distance from the origin.
        angle: uniform that gives the direction.
    """
    rho = radius * sp.sqrt(area)
    return rho * sp.cos(2 * sp.pi * angle), rho * sp.sin(2 * sp.pi * angle)
