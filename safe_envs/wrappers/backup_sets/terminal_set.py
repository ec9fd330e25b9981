"""Terminal sets of backup laws, derived from an equilibrium and proved.

The shape of a set comes from a Lyapunov equation, its size from the proof: the largest level that
`safe_envs.wrappers.backup_sets.invariance` proves, within the extent that the law gives.

**Shape.** With the Jacobian A of a block's control period at the equilibrium, and the extents w, P
= LL' = sum_k (A/r)'^k Q (A/r)^k with Q = diag(1/w^2). As (A/r)' P (A/r) = P - Q <= P, A contracts
by r < 1 in the norm of P. Several r between the spectral radius of A and 1 are tried. Where A has a
basis of eigenvectors, P = sum_i |a_i|^2/s_i^2 is tried too, with a_i the parts of y along them and
s_i how far each reaches within the extents: it does not cut slow directions short. The set of the
largest volume is taken.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.interval_arithmetic import Interval
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, SystemDefinitionError
from safe_envs.problem.backup import Backup, BackupLaw, backup_of
from safe_envs.wrappers.backup_sets.held_law import Block, Disturbance, held_law
from safe_envs.wrappers.backup_sets.invariance import Conditions, Ellipsoid, is_kept

_SHARES = (0.2, 0.45, 0.7)
_SHRINKING = (1.0, 0.5, 0.25, 0.125)
_LEAST = 1e-4
_CLOSE = 1.1
_WORST_CONDITION = 1e4
_WIDTHS = (1e-30, 1e30)

BlockSet = tuple[tuple[sp.Symbol, ...], Ellipsoid]
"""Coordinates of a block, and the set that they stay in."""


def with_terminal_sets(
    problem: Any, system: ControlAffineSDE, margin: float = 0.0
) -> Backup | None:
    """Return the backup of a problem, each law with its terminal set as an expression.

    Args:
        problem: a `SafetyProblem`.
        system: the dynamics that are believed: its plant or its model.
        margin: which the barriers keep in sets that are derived.

    Returns:
        The backup with laws and terminal sets of the states alone, numbers in place of parameters;
        None if the problem states none.

    Raises:
        SystemDefinitionError: a law does not fit what its equilibrium claims.
        ConfigurationError: no set around an equilibrium could be proved.
    """
    stated = backup_of(problem)
    if stated is None:
        return None
    laws = tuple(
        BackupLaw(
            law.name,
            tuple(system.numeric(e) for e in law.law),
            system.numeric(law.terminal)
            if law.terminal is not None
            else terminal_expression(derived_sets(problem, system, law, margin)),
        )
        for law in stated.laws
    )
    return replace(stated, laws=laws)


def terminal_expression(sets: Sequence[BlockSet]) -> Any:
    """Return an expression that is >= 0 in the product of sets, the least 1 - |L'(y - e)|^2/c.

    Args:
        sets: of blocks of states.
    """
    return sp.Min(*(_of_block(symbols, e) for symbols, e in sets))


def derived_sets(
    problem: Any, system: ControlAffineSDE, law: BackupLaw, margin: float = 0.0
) -> tuple[BlockSet, ...]:
    """Return sets around a law's equilibrium, whose product is proved to be kept.

    Args:
        problem: a `SafetyProblem`.
        system: the dynamics that are believed.
        law: with an equilibrium.
        margin: that no barrier falls below in the sets.

    Raises:
        SystemDefinitionError: the coordinates of the equilibrium do not close, a barrier needs
            others, or one without a finite workspace has no extent.
        ConfigurationError: the law does not hold the equilibrium, or nothing could be proved.
    """
    widths = {v.symbol: 0.5 * (v.high - v.low) for v in problem.states}
    extent = {s: law.extent.get(s, widths[s]) for s in law.equilibrium}
    endless = [str(s) for s, width in extent.items() if not math.isfinite(width)]
    if endless:
        raise SystemDefinitionError(
            f"backup law {law.name} needs an extent of {', '.join(endless)}, whose workspace is"
            " unbounded: say how far its terminal set may reach, like extent={x: 0.5}"
        )
    if not all(_WIDTHS[0] <= width <= _WIDTHS[1] for width in extent.values()):
        raise ConfigurationError(
            f"extent of backup law {law.name} = {extent}; give numbers in [{_WIDTHS[0]:g},"
            f" {_WIDTHS[1]:g}], in other units if need be"
        )
    return _derived(
        system,
        (law.name, law.law, tuple(law.equilibrium.items())),
        tuple(extent.items()),
        tuple(b.expression - sp.Float(margin, 17) for b in problem.barriers)
        if margin
        else tuple(b.expression for b in problem.barriers),
        problem.box,
        (problem.dt / problem.substeps, problem.substeps),
    )


def _of_block(symbols: Sequence[sp.Symbol], e: Ellipsoid) -> Any:
    """Return 1 - |L'(y - e)|^2/c, with the floats as they are."""
    away = [s - sp.Float(c, 17) for s, c in zip(symbols, e.center.tolist(), strict=True)]
    scale = sp.Float(1.0 / math.sqrt(e.level), 17)
    rows = [
        sum(scale * sp.Float(r, 17) * d for r, d in zip(column, away, strict=True) if r)
        for column in e.root.T.tolist()
    ]
    return 1 - sum(row**2 for row in rows)


@lru_cache(maxsize=64)
def _derived(
    system: ControlAffineSDE,
    stated: tuple[str, tuple[sp.Expr, ...], tuple[tuple[sp.Symbol, sp.Expr], ...]],
    extents: tuple[tuple[sp.Symbol, float], ...],
    barriers: tuple[sp.Expr, ...],
    box: tuple[tuple[float, float], ...],
    timing: tuple[float, int],
) -> tuple[BlockSet, ...]:
    name, laws, equilibrium = stated
    loop = held_law(system, BackupLaw(name, laws, None, dict(equilibrium)), *timing)
    expressions: list[Any] = [*barriers, *loop.switches]
    for entry, (low, high) in zip(loop.law, box, strict=True):
        expressions += [entry - sp.Float(low, 17), sp.Float(high, 17) - entry]
    known = tuple(s for s, _ in equilibrium)
    for e in expressions:
        what = f"what the terminal set of backup law {name} has to keep,"
        system.require_known(what, e.free_symbols, known)
    checked = []
    for block in reversed(loop.blocks):  # A condition belongs to the last block that is in it.
        own = [e for e in expressions if e.free_symbols & set(block.symbols)]
        expressions = [e for e in expressions if e not in own]
        checked.append((block, Conditions(block, own)))
    if not all(float(e) >= 0.0 for e in expressions):  # These are constants.
        raise _unproved(name, equilibrium)
    for shrinking in _SHRINKING:
        found = _product(checked[::-1], {s: shrinking * w for s, w in extents}, name)
        if found is not None:
            return found
    raise _unproved(name, equilibrium)


def _unproved(name: str, equilibrium: Sequence[tuple[sp.Symbol, Any]]) -> ConfigurationError:
    return ConfigurationError(
        f"backup law {name} could not be proved to keep any set around its equilibrium"
        f" {dict(equilibrium)}; look whether it is one, whether it is safe and within the input"
        " bounds, and whether the law holds it with this control period"
    )


def _product(
    blocks: Sequence[tuple[Block, Conditions]], extent: dict[sp.Symbol, float], name: str
) -> tuple[BlockSet, ...] | None:
    """Return sets of the blocks, each within an extent; None where one could not be proved."""
    nothing = Interval(np.zeros(0), np.zeros(0))
    disturbed, sets = Disturbance(nothing, nothing), []
    for block, conditions in blocks:
        widths = np.array([extent[s] for s in block.symbols])
        e = _largest(block, conditions, disturbed, widths, name)
        if e is None:
            return None
        sets.append((block.symbols, e))
        box = e.box()
        within = block.period(Interval(box.low[None, :], box.high[None, :]), disturbed).within
        disturbed = Disturbance(_joined(disturbed.held, box), _joined(disturbed.within, within))
    return tuple(sets)


def _largest(
    block: Block, conditions: Conditions, disturbed: Disturbance, widths: np.ndarray, name: str
) -> Ellipsoid | None:
    """Return the set of the largest volume that is proved; None without any.

    Raises:
        ConfigurationError: the law does not stabilise its equilibrium.
    """
    point = Interval(block.rest[None, :], block.rest[None, :])
    a = block.period(point, disturbed).slope.center[0]
    if not np.isfinite(a).all():
        return None
    radius = float(abs(np.linalg.eigvals(a)).max())
    if not radius < 1.0:
        raise ConfigurationError(
            f"backup law {name} does not bring {', '.join(map(str, block.symbols))} back to the"
            f" equilibrium: held for control periods, deviations are multiplied by {radius:.4g} in"
            " each; give a law that brings them back, or a shorter dt"
        )
    if (conditions.least(point, disturbed) < 0.0).any():
        return None
    best: tuple[float, Ellipsoid] | None = None
    for p, root in _with_roots(_shapes(a, radius, widths)):
        most = float((widths**2 / np.diag(np.linalg.inv(p))).min())
        level = _largest_level(block, conditions, disturbed, root, most)
        if level is not None:
            volume = 0.5 * len(root) * math.log(level) - float(np.linalg.slogdet(root)[1])
            if best is None or volume > best[0]:
                best = volume, Ellipsoid(block.rest, root, level)
    return None if best is None else best[1]


def _shapes(a: np.ndarray, radius: float, widths: np.ndarray) -> list[np.ndarray]:
    """Return forms P in whose norms a map contracts.

    Args:
        a: A, shape (n, n).
        radius: its spectral radius.
        widths: w, shape (n,).
    """
    from scipy.linalg import solve_discrete_lyapunov

    shapes = []
    for share in _SHARES:
        scale = radius + share * (1.0 - radius)
        shapes.append(solve_discrete_lyapunov((a / scale).T, np.diag(1.0 / widths**2)))
    right = np.linalg.eig(a)[1]
    if np.linalg.cond(right / widths[:, None]) < _WORST_CONDITION:
        sizes = (widths[:, None] / np.maximum(np.abs(right), 1e-300)).min(axis=0)
        modes = np.linalg.inv(right * sizes)
        shapes.append((modes.conj().T @ modes).real)
    return [0.5 * (p + p.T) for p in shapes]


def _with_roots(shapes: Sequence[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield P and L of each P = LL' that has an L in floating point."""
    for p in shapes:
        with suppress(np.linalg.LinAlgError):
            yield p, np.linalg.cholesky(p)


def _largest_level(
    block: Block, conditions: Conditions, disturbed: Disturbance, root: np.ndarray, most: float
) -> float | None:
    """Return the largest level up to a given one that is proved, to a tenth; None without any."""

    def proved(level: float) -> bool:
        return is_kept(block, conditions, Ellipsoid(block.rest, root, level), disturbed)

    if proved(most):
        return most
    low, high = 0.0, most
    level = 0.25 * most
    while high > _CLOSE * low:
        if proved(level):
            low = level
        elif level < _LEAST * most:
            return None
        else:
            high = level
        level = math.sqrt(low * high) if low else 0.25 * high
    return low


def _joined(a: Interval, b: Interval) -> Interval:
    return Interval(np.concatenate([a.low, b.low]), np.concatenate([a.high, b.high]))
