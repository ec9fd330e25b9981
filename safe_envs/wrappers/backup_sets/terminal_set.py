"""Terminal sets of backup laws, derived from an equilibrium and proved.

The shape of the set comes from a Lyapunov equation, its size from the proof: the largest level that
`safe_envs.wrappers.backup_sets.invariance` proves, found by bisection.

**Shape.** With the Jacobian A of a control period at the equilibrium and the extents w that a law
gives, P = LL' = sum_k (A/r)'^k Q (A/r)^k, Q = diag(1/w^2). Then (A/r)' P (A/r) = P - Q <= P: A contracts
by r < 1 in the norm of P. Several r between the spectral radius of A and 1 are tried, and the set of
the largest volume is taken.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp
from scipy.linalg import solve_discrete_lyapunov

from safe_envs.dynamics.interval_arithmetic import Interval
from safe_envs.dynamics.intervals import interval_function
from safe_envs.dynamics.lie import has_kinks
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, SystemDefinitionError
from safe_envs.problem.backup import Backup, BackupLaw, backup_of
from safe_envs.wrappers.backup_sets.closed_loop import ClosedLoop, closed_loop
from safe_envs.wrappers.backup_sets.invariance import Conditions, Ellipsoid, is_kept

_SHARES = (0.15, 0.35, 0.55, 0.75, 0.9)
_HALVINGS = 12
_FARTHEST = 40
_NO_SLOPE = sp.Float(1e100)


def with_terminal_sets(problem: Any, system: ControlAffineSDE) -> Backup | None:
    """Return the backup of a problem, each law with its terminal set as an expression.

    Args:
        problem: a `SafetyProblem`.
        system: the dynamics that are believed: its plant or its model.

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
        replace(
            law,
            law=tuple(system.numeric(e) for e in law.law),
            terminal=system.numeric(law.terminal)
            if law.terminal is not None
            else terminal_expression(law, derived_set(problem, system, law)),
            equilibrium={},
            extent={},
        )
        for law in stated.laws
    )
    return Backup(laws, stated.horizon)


def terminal_expression(law: BackupLaw, found: Ellipsoid) -> sp.Expr:
    """Return c - |L'(y - e)|^2 as an expression of the states.

    Args:
        law: whose equilibrium names the coordinates.
        found: the set.
    """
    away = [
        s - sp.Float(e, 17) for s, e in zip(law.equilibrium, found.center.tolist(), strict=True)
    ]
    rows = [
        sum(sp.Float(root, 17) * d for root, d in zip(column, away, strict=True) if root)
        for column in found.root.T.tolist()
    ]
    return sp.Float(found.level, 17) - sum(row**2 for row in rows)


def derived_set(problem: Any, system: ControlAffineSDE, law: BackupLaw) -> Ellipsoid:
    """Return the largest set around a law's equilibrium that is proved to be kept.

    Args:
        problem: a `SafetyProblem`.
        system: the dynamics that are believed.
        law: with an equilibrium.

    Raises:
        SystemDefinitionError: the coordinates of the equilibrium do not close, a barrier needs
            others, or one without a finite workspace has no extent.
        ConfigurationError: the law does not hold the equilibrium, or nothing could be proved.
    """
    widths = {v.symbol: 0.5 * (v.high - v.low) for v in problem.states}
    endless = [str(s) for s in law.equilibrium if not math.isfinite(law.extent.get(s, widths[s]))]
    if endless:
        raise SystemDefinitionError(
            f"backup law {law.name} needs an extent of {', '.join(endless)}, whose workspace is"
            " unbounded: say about how far its terminal set is to reach, like extent={x: 0.5}"
        )
    return _derived(
        system,
        law.name,
        law.law,
        tuple(law.equilibrium.items()),
        tuple(b.expression for b in problem.barriers),
        problem.box,
        (problem.dt / problem.substeps, problem.substeps),
        tuple(law.extent.get(s, widths[s]) for s in law.equilibrium),
    )


@lru_cache(maxsize=64)
def _derived(
    system: ControlAffineSDE,
    name: str,
    laws: tuple[sp.Expr, ...],
    equilibrium: tuple[tuple[sp.Symbol, sp.Expr], ...],
    barriers: tuple[sp.Expr, ...],
    box: tuple[tuple[float, float], ...],
    timing: tuple[float, int],
    extent: tuple[float, ...],
) -> Ellipsoid:
    loop = closed_loop(system, BackupLaw(name, laws, None, dict(equilibrium)), *timing)
    expressions = [*barriers, *loop.switches]
    for entry, (low, high) in zip(loop.law, box, strict=True):
        expressions += [entry - sp.Float(low, 17), sp.Float(high, 17) - entry]
    for e in expressions:
        system.require_known(
            f"what the terminal set of backup law {name} has to keep,", e.free_symbols, loop.symbols
        )
    conditions = _conditions(loop, expressions)
    best: tuple[float, Ellipsoid] | None = None
    for root in _shapes(loop, extent, name):
        level = _largest_level(loop, conditions, root)
        if level is not None:
            volume = 0.5 * len(root) * math.log(level) - np.linalg.slogdet(root)[1]
            if best is None or volume > best[0]:
                best = volume, Ellipsoid(loop.rest, root, level)
    if best is None:
        raise ConfigurationError(
            f"backup law {name} could not be proved to keep any set around its equilibrium"
            f" {dict(equilibrium)}; look whether it is one, whether it is safe and within the input"
            " bounds, and whether the law holds it with this control period"
        )
    return best[1]


def _conditions(loop: ClosedLoop, expressions: list[Any]) -> Conditions:
    slopes = [_NO_SLOPE if has_kinks(e) else e.diff(s) for e in expressions for s in loop.symbols]
    return Conditions(
        interval_function(loop.symbols, expressions),
        interval_function(loop.symbols, slopes),
        len(expressions),
    )


def _shapes(loop: ClosedLoop, extent: tuple[float, ...], name: str) -> list[np.ndarray]:
    """Return roots L of the forms that are tried.

    Raises:
        ConfigurationError: the law does not stabilise its equilibrium.
    """
    point = Interval(loop.rest[None, :], loop.rest[None, :])
    a = loop.period(point)[1].center[0]
    radius = float(abs(np.linalg.eigvals(a)).max())
    if not radius < 1.0:
        raise ConfigurationError(
            f"backup law {name} does not bring the system back to its equilibrium: held for control"
            f" periods, deviations grow by {radius:.4g} a period; give a law that does, or a"
            " shorter dt"
        )
    q = np.diag(1.0 / np.array(extent) ** 2)
    roots = []
    for share in _SHARES:
        scale = radius + share * (1.0 - radius)
        p = solve_discrete_lyapunov((a / scale).T, q)
        roots.append(np.linalg.cholesky(0.5 * (p + p.T)))
    return roots


def _largest_level(loop: ClosedLoop, conditions: Conditions, root: np.ndarray) -> float | None:
    """Return the largest level that is proved, to a few percent; None without any."""

    def proved(level: float) -> bool:
        return is_kept(loop, conditions, Ellipsoid(loop.rest, root, level))

    high = 4.0
    for _ in range(_FARTHEST):
        low = high / 4.0
        if proved(low):
            break
        high = low
    else:
        return None
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if proved(middle) else (low, middle)
        if high < 1.02 * low:
            break
    return low
