"""A problem from a system, its barriers and a few numbers; the rest has defaults."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.dynamics.symbols import formula
from safe_envs.errors import ConfigurationError, SystemDefinitionError, nearest, shown
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Variable, bound_pairs
from safe_envs.problem.starts import Start
from safe_envs.problem.validation import degree_of, require_sound
from safe_envs.text import finite_number

_UNBOUNDED = (-math.inf, math.inf)

_STATED = (
    "name",
    "plant",
    "model",
    "barriers",
    "states",
    "inputs",
    "reward",
    "nominal",
    "starts",
    "start",
    "dt",
    "horizon",
    "rates",
)
"""Attributes of a problem that are made of the arguments."""

Range = tuple[float, float]


def define_problem(  # noqa: PLR0913  (what a user states, by keyword)
    system: ControlAffineSDE,
    barriers: Any,
    *,
    input_bounds: Any,
    start: Any,
    dt: float,
    horizon: float,
    name: str = "",
    model: ControlAffineSDE | None = None,
    nominal: Any = 0,
    reward: Any = 0,
    workspace: Mapping[sp.Symbol, Range] | None = None,
    units: Mapping[sp.Symbol, str] | None = None,
    **rest: Any,
) -> SafetyProblem:
    """Build a safety problem.

    Args:
        system: what is simulated.
        barriers: h, safe where h >= 0: an expression of the states or a `Barrier`, or several of
            them.
        input_bounds: physical bounds (low, high) of every input, or one such pair for each.
        start: of each state a number, or (low, high) to draw it from, uniformly, where every
            barrier is positive; always one entry for each state.
        dt: control period in s.
        horizon: length of an episode in s.
        name: of the problem, for tables and pictures.
        model: what filters and the nominal controller believe, with the same states and inputs;
            `system` itself by default.
        nominal: the controller that is to be kept safe, an expression of the states and of
            parameters for each input; where `features` are given, of their symbols in place of the
            states'.
        reward: of a step, an expression of the state that it reaches, of the input and of
            `safe_envs.problem.signals.TIME`.
        workspace: (low, high) of states; an episode ends when one leaves it. The others are
            unbounded.
        units: of states and inputs, by symbol: labels, which nothing checks, for numbers and
            parameters have none. A state in "rad" without bounds is an angle.
        **rest: other attributes of `SafetyProblem`. By default `noise` are the parameters that
            occur in the diffusion alone, `gains` ones for every barrier's relative degree, `filter`
            "szcbf" with noise and "hocbf" without, and `plane` the states if they are two. A
            `frame` declares coordinates in which the problem closes (see
            `safe_envs.problem.frame.Frame`): tables of values then need an axis for each of these
            in place of the states. It is checked before it is used.

    Raises:
        SystemDefinitionError: the parts do not fit together, or hold a mistake: see
            `safe_envs.problem.validation`.
        RelativeDegreeError: no input reaches a barrier.
        ConfigurationError: a number is out of range.
    """
    named = named_barriers(barriers)
    if not isinstance(system, ControlAffineSDE):
        raise SystemDefinitionError(f"system is {type(system).__name__}; give a ControlAffineSDE")
    _require_known(rest, system)
    laws = _listed(nominal, system.m)
    bounds, unit = dict(workspace or {}), dict(units or {})
    _require_symbols("workspace", bounds, system.states)
    _require_symbols("units", unit, (*system.states, *system.inputs))
    states = tuple(
        Variable(s, *_ends(f"workspace of {s}", bounds.get(s, _UNBOUNDED)), unit.get(s, ""))
        for s in system.states
    )
    problem = SafetyProblem(
        name=name or "problem",
        plant=system,
        model=system if model is None else model,
        barriers=named,
        states=states,
        inputs=tuple(
            Variable(u, *ends, unit.get(u, ""))
            for u, ends in zip(system.inputs, bound_pairs(input_bounds, system.m), strict=True)
        ),
        reward=formula("reward", reward),
        nominal=tuple(
            formula("nominal", law) if rest.get("features") else law_of(law, system) for law in laws
        ),
        starts={"start": _start(states, named, start)},
        dt=finite_number("dt", dt),
        horizon=finite_number("horizon", horizon),
        **{**suitable(system, named), **rest},
    )
    require_sound(problem)
    return problem


def named_barriers(barriers: Any) -> tuple[Barrier, ...]:
    """Return one or several expressions or barriers as barriers, each with a name.

    Raises:
        SystemDefinitionError: there is none, or one is no expression.
    """
    given = list(barriers) if isinstance(barriers, list | tuple) else [barriers]
    if not given:
        raise SystemDefinitionError(
            "barriers is empty; give h, an expression of the states, or several"
        )
    several = len(given) > 1
    return tuple(
        b if isinstance(b, Barrier) else Barrier(b, f"h_{i}" if several else "h")
        for i, b in enumerate(given, 1)
    )


def suitable(system: ControlAffineSDE, barriers: Sequence[Barrier]) -> dict[str, Any]:
    """Return noise, gains, filter and plane of a problem as they suit a system.

    Args:
        system: the dynamics.
        barriers: what is safe.

    Raises:
        RelativeDegreeError: no input reaches a barrier.
    """
    elsewhere = system.drift.free_symbols | system.input_matrix.free_symbols
    degrees = [degree_of(system, b.expression) for b in barriers]
    return {
        "noise": tuple(
            p.name for p in system.parameters if p in system.diffusion.free_symbols - elsewhere
        ),
        "gains": (
            tuple((1.0,) * degree for degree in degrees)
            if len(set(degrees)) > 1
            else (1.0,) * degrees[0]
        ),
        "filter": "szcbf" if system.noisy else "hocbf",
        "plane": tuple(s.name for s in system.states) if system.n == 2 else None,
    }


def law_of(law: Any, system: ControlAffineSDE) -> sp.Expr:
    """Return a law of the states as a law of the features, which have their own symbols.

    Args:
        law: of the states and the parameters.
        system: the dynamics.
    """
    return formula("nominal", law).subs({s: sp.Symbol(s.name, real=True) for s in system.states})


def _require_known(rest: Mapping[str, Any], system: ControlAffineSDE) -> None:
    """Raise ConfigurationError where a further attribute is unknown, or names what is not there."""
    allowed = [f.name for f in fields(SafetyProblem) if f.init and f.name not in _STATED]
    for name in rest:
        if name not in allowed:
            raise ConfigurationError(
                f"a problem has no further {shown(name)}; {nearest(name, allowed)}"
            )
    parameters, states = [p.name for p in system.parameters], [s.name for s in system.states]
    for name, known, what in (
        ("noise", parameters, "parameters of the diffusion"),
        ("plane", states, "states, two of them"),
    ):
        given = rest.get(name)
        if given is not None and not (isinstance(given, list | tuple) and set(given) <= set(known)):
            raise ConfigurationError(
                f"{name} = {given!r}; it names {what} ({', '.join(known) or 'there are none'}),"
                f" like {name}=(...,)"
            )
    if "gains" in rest and not isinstance(rest["gains"], list | tuple):
        raise ConfigurationError(
            f"gains = {rest['gains']!r}; give a tuple of rates, one for each order, or such a tuple"
            " for each barrier"
        )


def _listed(laws: Any, count: int) -> list[Any]:
    if isinstance(laws, sp.MatrixBase):
        return laws.flat()
    return list(laws) if isinstance(laws, list | tuple) else [laws] * count


def _start(states: Sequence[Variable], barriers: Sequence[Barrier], start: Any) -> Start:
    names = ", ".join(s.symbol.name for s in states)
    given = start.tolist() if isinstance(start, np.ndarray) else start
    if not isinstance(given, list | tuple) or len(given) != len(states):
        raise SystemDefinitionError(
            f"start = {start!r}; give a number or (low, high) for each of the {len(states)} states:"
            f" {names}"
        )
    ends = [
        _ends(f"start of {s.symbol}", v if isinstance(v, list | tuple | np.ndarray) else (v, v))
        for s, v in zip(states, given, strict=True)
    ]
    for s, (low, high) in zip(states, ends, strict=True):
        finite_number(f"start of {s.symbol}", low)
        finite_number(f"start of {s.symbol}", high)
    if all(low == high for low, high in ends):
        return Start.at([low for low, _ in ends])
    uniforms = sp.symbols(f"uniform_1:{len(states) + 1}", real=True)
    state = tuple(
        low + (high - low) * uniform for (low, high), uniform in zip(ends, uniforms, strict=True)
    )
    within = [
        distance
        for s, (low, high) in zip(states, ends, strict=True)
        for distance, leaves in (
            (s.symbol - s.low, low < s.low),
            (s.high - s.symbol, high > s.high),
        )
        if leaves
    ]
    return Start(state, uniforms, sp.Min(*[b.expression for b in barriers], *within))


def _ends(what: str, given: Any) -> Range:
    """Return (low, high) as floats, possibly infinite."""
    try:
        low, high = (float(v) for v in given)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"{what} = {shown(given)}; give (low, high)") from error
    if not low <= high:
        raise ConfigurationError(f"{what} = {shown(given)}; give (low, high) with low <= high")
    return low, high


def _require_symbols(what: str, given: Mapping[Any, Any], allowed: Sequence[sp.Symbol]) -> None:
    for symbol in given:
        if symbol not in allowed:
            names = ", ".join(map(str, allowed))
            raise SystemDefinitionError(
                f"{what} names {symbol!r}, which is none of the symbols {names}; give the symbol"
                " itself, no text"
            )
