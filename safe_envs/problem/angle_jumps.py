"""By how much an expression of angles jumps, which is where one of them has gone a full turn."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import sympy as sp

from safe_envs.dynamics.identities import is_zero

Jumps = tuple[float, ...] | None
"""Sizes, NaN for one that is no number; None where they are not derived."""

_SWITCHING = (sp.Piecewise, sp.Heaviside, sp.sign, sp.floor, sp.ceiling)
_POLES = (sp.tan, sp.cot, sp.sec, sp.csc, sp.coth, sp.csch)
_ROUNDING = 1e-6
"""Part of a period by which a stated one may be off, as 6.28319 is for 2 pi."""


def angle_jumps(expression: sp.Expr) -> Jumps:
    """Return by how much an expression jumps at the ends of its angles.

    Angles are atan2, the arc tangent of a quotient, which jump by 2 pi and pi, and remainders. Of a
    atan2(y, x) + b the size is 2 pi |a|; cos(atan2(y, x)) does not jump.

    Args:
        expression: of real symbols.

    Returns:
        () for an expression without jumps of angles; NaN for a size that is no number, as that of
        x atan2(y, x); None for pieces, steps and whole numbers of angles, and angles of angles.
    """
    stand_ins: dict[Any, Any] = {angle: sp.Dummy(real=True) for angle in _angles(expression)}
    rest: Any = expression.xreplace(stand_ins)
    found: set[float] = set()
    if any(part.free_symbols & set(stand_ins.values()) for part in rest.atoms(*_SWITCHING)):
        return None
    for angle, symbol in stand_ins.items():
        low, high = _ends(angle)
        inner = [angle_jumps(part) for part in angle.args]
        if any(
            jumps is None or not all(_is_multiple(jump, high - low) for jump in jumps)
            if angle.func in (sp.Mod, sp.frac)
            else jumps != ()
            for jumps in inner
        ):
            return None
        size: Any = sp.diff(rest, symbol) * (high - low)
        if size.is_number:
            found.add(abs(float(size)))
        elif not is_zero(rest.subs(symbol, high) - rest.subs(symbol, low)):
            found.add(math.nan)
    return tuple(sorted(found))


def are_multiples(jumps: Sequence[float], period: float) -> bool:
    """Return whether values are continuous modulo a period.

    Args:
        jumps: of their expression.
        period: 0 for none.
    """
    return all(_is_multiple(jump, period) for jump in jumps)


def words_of(jumps: Jumps) -> str:
    """Return by how much an expression jumps, in words."""
    if jumps is None or not all(map(math.isfinite, jumps)):
        return "by no one number"
    return f"by {', '.join(f'{jump:g}' for jump in jumps)}"


def without_remainders(expression: Any) -> Any:
    """Return an expression with the argument in place of each remainder, which differ by jumps.

    Args:
        expression: that is known modulo a period.
    """
    return expression.replace(sp.Mod, lambda value, _: value).replace(sp.frac, lambda value: value)


def _angles(expression: Any) -> Iterator[Any]:
    """Return the angles that are in no other one."""
    is_arc = isinstance(expression, sp.atan | sp.acot) and _has_pole(expression)
    if is_arc or isinstance(expression, sp.atan2 | sp.Mod | sp.frac):
        yield expression
    else:
        for part in expression.args:
            yield from _angles(part)


def _has_pole(arc: Any) -> bool:
    """Return whether the arc tangent, or cotangent, of something may jump."""
    argument: Any = arc.args[0]
    argument = 1 / argument if isinstance(arc, sp.acot) else argument
    denominator = sp.fraction(sp.together(argument))[1]
    return bool(argument.atoms(*_POLES)) or not (denominator.is_positive or denominator.is_negative)


def _ends(angle: Any) -> tuple[Any, Any]:
    """Return the ends of the values of an angle."""
    if isinstance(angle, sp.Mod | sp.frac):
        return sp.S.Zero, angle.args[1] if isinstance(angle, sp.Mod) else sp.S.One
    return (-sp.pi, sp.pi) if isinstance(angle, sp.atan2) else (-sp.pi / 2, sp.pi / 2)


def _is_multiple(jump: float, period: Any) -> bool:
    if not (sp.sympify(period).is_number and period):
        return False
    turns = jump / abs(float(period))
    return (
        math.isfinite(turns)
        and turns > 0.5
        and math.isclose(turns, round(turns), rel_tol=_ROUNDING)
    )
