"""Mistakes in the definition of a problem, found before they show as wrong results."""

from __future__ import annotations

import math
import warnings
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function, stacked
from safe_envs.dynamics.lie import (
    generator,
    lie_derivative_f,
    lie_derivative_g,
    relative_degree,
)
from safe_envs.dynamics.min_max import clauses
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import SystemDefinitionError, SystemDefinitionWarning
from safe_envs.problem.problem import SafetyProblem

_STARTS = 256
_FEW = 0.05
_OTHER_UNITS = 100.0
"""A factor that a designer seldom chooses, but a wrong unit makes."""

_sound: weakref.WeakValueDictionary[int, SafetyProblem] = weakref.WeakValueDictionary()


def require_sound(problem: SafetyProblem) -> None:
    """Look for mistakes in a problem, mostly at its starts; once for each problem.

    Wrong are: an input that nothing depends on; a barrier that no input reaches; gains that are not
    one positive number for each order; functions without a finite value; and starts of which all
    are outside the safe set (an h of the wrong sign) or the workspace.

    Doubtful is what other units than the model's would explain: few of the drawn starts are safe
    (degrees for radians); the nominal controller asks for a hundred times what the input bounds
    hold, or a barrier's condition for a hundred times what they can do, at every start; an input
    within them throws a state across its whole workspace within a control period.

    Raises:
        SystemDefinitionError: something is wrong.
        RelativeDegreeError: no input reaches a barrier.
        ConfigurationError: a parameter leads to a division by 0.

    Warns:
        SystemDefinitionWarning: something is doubtful.
    """
    if _sound.get(id(problem)) is problem:
        return
    for system in (problem.plant, problem.model):
        _require_inputs_used(system)
        for i, barrier in enumerate(problem.barriers):
            degree = degree_of(system, barrier.expression)
            _require_gains(problem.gains_of(i), barrier.name, degree)
    x = _safe_starts(problem)
    _require_finite(problem, x)
    _doubt_box_of_nominal(problem, x)
    _doubt_box_of_barriers(problem, x)
    _doubt_box_of_workspace(problem, x)
    _sound[id(problem)] = problem


def degree_of(system: ControlAffineSDE, h: sp.Expr) -> int:
    """Return the relative degree: along the Ito generator with noise, along the drift without.

    Args:
        system: the dynamics.
        h: a function of the states.

    Raises:
        RelativeDegreeError: no input reaches h.
    """
    return relative_degree(system, h, generator if system.noisy else lie_derivative_f)


def _values(symbols: Sequence[sp.Symbol], expressions: Sequence[Any], x: Components) -> np.ndarray:
    """Evaluate expressions at states: shape (B, len(expressions)), not finite without a value."""
    with np.errstate(all="ignore"):
        return stacked(compile_function(symbols, expressions, "arrays")(*x), len(x[0]))


def _require_inputs_used(system: ControlAffineSDE) -> None:
    for name in ("drift", "input_matrix", "diffusion"):
        system.numeric(getattr(system, name))
    numbers = system.numeric(system.input_matrix)
    for j, u in enumerate(system.inputs):
        if all(entry == 0 for entry in numbers[:, j]):
            raise SystemDefinitionError(
                f"input {u} never appears: its column of the input matrix is 0; leave it out, or"
                " say what it does"
            )


def _require_gains(gains: Sequence[float], name: str, degree: int) -> None:
    numbers = all(isinstance(gain, int | float) and 0.0 < gain < math.inf for gain in gains)
    if len(gains) != degree or not numbers:
        raise SystemDefinitionError(
            f"gains of {name} = {gains}; its relative degree is {degree}: give as many positive"
            " numbers"
        )


def _safe_starts(problem: SafetyProblem) -> Components:
    """Return the starts that are in the workspace and safe."""
    proposals = problem.starts[problem.start].proposals(_STARTS)
    x, states = tuple(proposals.T.copy()), problem.plant.states
    within = np.ones(_STARTS, dtype=bool)
    for state, values in zip(problem.states, x, strict=True):
        inside = (values >= state.low) & (values <= state.high)
        if not inside.any():
            raise SystemDefinitionError(
                f"every start is outside the workspace: {state.symbol} = {values[0]:.6g} is not in"
                f" [{state.low:g}, {state.high:g}]"
            )
        within &= inside
    h = _values(states, [b.expression for b in problem.barriers], x)
    for barrier, values in zip(problem.barriers, h.T, strict=True):
        if not np.isfinite(values).any():
            raise SystemDefinitionError(
                f"barrier {barrier.name} = {barrier.expression} has no finite value at the start"
                f" {_at(problem, x, 0)}"
            )
        if not (values > 0.0).any():
            best = int(np.nanargmax(values))
            raise SystemDefinitionError(
                f"every start is unsafe: {barrier.name} = {barrier.expression} is at most"
                f" {values[best]:.6g}, at {_at(problem, x, best)}. An episode has to start where h"
                " > 0: look for a wrong sign, or start elsewhere"
            )
    kept = within & (h > 0.0).all(axis=1)
    if not kept.any():
        raise SystemDefinitionError(
            "no start is safe for all barriers at once and in the workspace: look at their signs"
        )
    if kept.mean() < _FEW and problem.starts[problem.start].uniforms:
        _doubt(
            f"only {100 * kept.mean():.2g} % of the starts that are drawn are safe: check their"
            " units (degrees for radians?)"
        )
    return tuple(component[kept] for component in x)


def _require_finite(problem: SafetyProblem, x: Components) -> None:
    for believed, system in (("plant", problem.plant), ("model", problem.model)):
        for name in ("drift", "input_matrix", "diffusion"):
            _require_numbers(
                f"{name} of the {believed}", problem, list(system.numeric(getattr(system, name))), x
            )
    laws = _laws(problem)
    if laws is not None:
        _require_numbers("the nominal controller", problem, laws, x)


def _require_numbers(
    what: str, problem: SafetyProblem, expressions: Sequence[Any], x: Components
) -> None:
    bad = ~np.isfinite(_values(problem.plant.states, expressions, x))
    if bad.any():
        i, j = np.argwhere(bad)[0].tolist()
        raise SystemDefinitionError(
            f"{what} has no finite value at the start {_at(problem, x, i)}: look at"
            f" {expressions[j]}"
        )


def _laws(problem: SafetyProblem) -> list[Any] | None:
    """Return the nominal controller as expressions of the states; None if it depends on time."""
    features = {f.symbol: f.expression for f in problem.features}
    laws = [problem.model.numeric(law).subs(features, simultaneous=True) for law in problem.nominal]
    return None if any(set(law.free_symbols) - set(problem.plant.states) for law in laws) else laws


def _doubt_box_of_nominal(problem: SafetyProblem, x: Components) -> None:
    laws = _laws(problem)
    if laws is None:
        return
    for variable, asked in zip(
        problem.inputs, abs(_values(problem.plant.states, laws, x)).T, strict=True
    ):
        least, most = float(asked.min()), max(abs(variable.low), abs(variable.high))
        if least > _OTHER_UNITS * most:
            _doubt(
                f"the nominal controller asks for |{variable.symbol}| >= {least:.4g} at every"
                f" start, and its bounds [{variable.low:g}, {variable.high:g}] end at {most:.4g}:"
                f" check that both have the unit {variable.unit or 'of the model'}"
            )


def _doubt_box_of_barriers(problem: SafetyProblem, x: Components) -> None:
    """Warn where the condition of a barrier is far out of reach at every start."""
    model = problem.model
    for i, barrier in enumerate(problem.barriers):
        # Of a maximum, another function may do.
        for h in [each[0] for each in clauses(barrier.expression) if len(each) == 1]:
            chain, gains = model.numeric(h), problem.gains_of(i)
            for gain in gains[:-1]:
                chain = _smooth(generator(model, chain)) + gain * chain
            rate = _smooth(generator(model, chain))
            effect = _smooth(model.numeric(lie_derivative_g(model, chain)))
            best = sum(
                sp.Max(e * variable.low, e * variable.high)
                for e, variable in zip(effect, problem.inputs, strict=True)
            )
            without, reach = _values(
                model.states, [model.numeric(rate + gains[-1] * chain), best], x
            ).T
            if (without < -_OTHER_UNITS * abs(reach)).all():
                nearest = int((abs(reach) / -without).argmax())
                _doubt(
                    f"the input bounds are too narrow for {barrier.name} at every start: at"
                    f" {_at(problem, x, nearest)} the condition lacks {-without[nearest]:.4g}, of"
                    f" which the inputs make up {reach[nearest]:.4g}: check the units of the bounds"
                    " and the gains"
                )


def _smooth(expression: Any) -> Any:
    """Leave out what sympy adds at kinks, which no start is likely to hit."""
    return expression.replace(sp.DiracDelta, lambda *_: sp.Integer(0))


def _doubt_box_of_workspace(problem: SafetyProblem, x: Components) -> None:
    plant = problem.plant
    moved = (
        _values(plant.states, [abs(e) for e in plant.numeric(plant.input_matrix)], x)
        .max(axis=0)
        .reshape(plant.n, plant.m)
    )
    for state, row in zip(problem.states, moved, strict=True):
        for variable, rate in zip(problem.inputs, row, strict=True):
            step, width = (
                rate * 0.5 * (variable.high - variable.low) * problem.dt,
                state.high - state.low,
            )
            if step > width:
                _doubt(
                    f"{variable.symbol} over half its box [{variable.low:g}, {variable.high:g}]"
                    f" moves {state.symbol} by {step:.4g} in a control period, across its whole"
                    f" workspace [{state.low:g}, {state.high:g}]: check their units"
                )


def _doubt(text: str) -> None:
    # The code that builds the problem is further up, by a depth that depends on the caller.
    warnings.warn(text, SystemDefinitionWarning, stacklevel=5)


def _at(problem: SafetyProblem, x: Components, i: int) -> str:
    return (
        "("
        + ", ".join(
            f"{s} = {component[i]:.6g}"
            for s, component in zip(problem.plant.states, x, strict=True)
        )
        + ")"
    )
