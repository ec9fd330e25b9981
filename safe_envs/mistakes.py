"""Mistakes in the statement of a problem that would only show as wrong results: they are found before the first step."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.calculus import generator, input_derivative, relative_degree
from safe_envs.codegen import Components, compile_function, stacked
from safe_envs.errors import SystemDefinitionError, SystemDefinitionWarning
from safe_envs.problem import SafetyProblem
from safe_envs.sde import ControlAffineSDE

_STARTS = 256
_OTHER_UNITS = 100.0
"""A factor that no choice of a designer makes, but a wrong unit does."""


def require_sound(problem: SafetyProblem) -> None:
    """Look for mistakes at the starts of a problem.

    Found are: an input that nothing depends on; a barrier that no input reaches; functions without a finite value; a start
    outside the safe set (an h of the wrong sign) or outside the workspace; and a box in other units than the model: one that is
    a hundred times too small for any condition with the problem's gains, or for the nominal controller, at every start. A box
    that throws a state across its whole workspace within a control period is doubtful.

    Raises:
        SystemDefinitionError: one was found.
        RelativeDegreeError: no input reaches a barrier.

    Warns:
        SystemDefinitionWarning: something is doubtful.
    """
    for system in (problem.plant, problem.model):
        _require_inputs_used(system)
        for barrier in problem.barriers:
            relative_degree(system, barrier.expression)
    x = _starts(problem)
    _require_finite(problem, x)
    _require_inside(problem, x)
    _require_box_for_nominal(problem, x)
    _require_box_for_barriers(problem, x)
    _doubt_box_of_workspace(problem, x)


def _starts(problem: SafetyProblem) -> Components:
    """States drawn from the problem's start, whether or not they meet its condition: components of shape (256,)."""
    start = problem.starts[problem.start]
    uniforms = np.random.default_rng(0).random((len(start.uniforms), _STARTS))
    return tuple(stacked(compile_function(start.uniforms, start.state, "arrays")(*uniforms), _STARTS).T.copy())


def _values(symbols: Sequence[sp.Symbol], expressions: Sequence[Any], x: Components) -> np.ndarray:
    """Expressions at states, shape (256, len(expressions)); NaN or infinite where they have no value."""
    with np.errstate(all="ignore"):
        return stacked(compile_function(symbols, expressions, "arrays")(*x), _STARTS)


def _require_inputs_used(system: ControlAffineSDE) -> None:
    numbers = system.numeric(system.input_matrix)
    for j, u in enumerate(system.inputs):
        if all(entry == 0 for entry in numbers[:, j]):
            raise SystemDefinitionError(f"input {u} never appears: its column of the input matrix is 0; leave it out, or say what it does")


def _require_finite(problem: SafetyProblem, x: Components) -> None:
    for believed, system in (("plant", problem.plant), ("model", problem.model)):
        for name in ("drift", "input_matrix", "diffusion"):
            _require_numbers(f"{name} of the {believed}", problem, list(system.numeric(getattr(system, name))), x)
    for barrier in problem.barriers:
        _require_numbers(f"barrier {barrier.name}", problem, [barrier.expression], x)


def _require_numbers(what: str, problem: SafetyProblem, expressions: Sequence[Any], x: Components) -> None:
    bad = ~np.isfinite(_values(problem.plant.states, expressions, x))
    if bad.any():
        i, j = np.argwhere(bad)[0].tolist()
        raise SystemDefinitionError(f"{what} has no finite value at the start {_at(problem, x, i)}: look at {expressions[j]}")


def _require_inside(problem: SafetyProblem, x: Components) -> None:
    for state, values in zip(problem.states, x, strict=True):
        if not ((values >= state.low) & (values <= state.high)).any():
            raise SystemDefinitionError(
                f"every start is outside the workspace: {state.symbol} = {values[0]:.6g} is not in [{state.low:g}, {state.high:g}]"
            )
    h = _values(problem.plant.states, [b.expression for b in problem.barriers], x)
    for barrier, values in zip(problem.barriers, h.T, strict=True):
        if (values <= 0.0).all():
            best = int(values.argmax())
            raise SystemDefinitionError(
                f"every start is unsafe: {barrier.name} = {barrier.expression} is at most {values[best]:.6g}, at {_at(problem, x, best)}. "
                "Safe is h >= 0: look for a wrong sign, or start elsewhere"
            )


def _require_box_for_nominal(problem: SafetyProblem, x: Components) -> None:
    """A controller asks for what the box can give, somewhere and more or less."""
    states = problem.plant.states
    features = {f.symbol: f.expression for f in problem.features}
    laws = [problem.model.numeric(law).subs(features, simultaneous=True) for law in problem.nominal]
    if any(set(law.free_symbols) - set(states) for law in laws):
        return  # A law of time is none of the starts alone.
    for variable, asked in zip(problem.inputs, abs(_values(states, laws, x)).T, strict=True):
        least, most = float(asked.min()), max(abs(variable.low), abs(variable.high))
        if least > _OTHER_UNITS * most:
            raise SystemDefinitionError(
                f"the nominal controller asks for |{variable.symbol}| >= {least:.4g} at every start, and the box "
                f"[{variable.low:g}, {variable.high:g}] ends at {most:.4g}: check that both have the unit {variable.unit or 'of the model'}"
            )


def _require_box_for_barriers(problem: SafetyProblem, x: Components) -> None:
    """The box can do something for each barrier: b_r, with the gains of the problem, is not out of all reach at every start."""
    model = problem.model
    half = [max(abs(i.low), abs(i.high)) for i in problem.inputs]
    for i, barrier in enumerate(problem.barriers):
        chain, gains = model.numeric(barrier.expression), problem.gains_of(i)
        for gain in gains[:-1]:
            chain = generator(model, chain) + gain * chain
        effect = [abs(e) * w for e, w in zip(model.numeric(input_derivative(model, chain)), half, strict=True)]
        last = [model.numeric(generator(model, chain) + gains[-1] * chain), model.numeric(sum(effect))]
        without, reach = _values(model.states, last, x).T
        if (without < -_OTHER_UNITS * reach).all() and reach.any():
            best = int((reach / -without).argmax())
            raise SystemDefinitionError(
                f"the box is too small for {barrier.name} at every start: at {_at(problem, x, best)} the condition lacks "
                f"{-without[best]:.4g}, of which the inputs can make up {reach[best]:.4g}: check the units of the box and the gains {gains}"
            )


def _doubt_box_of_workspace(problem: SafetyProblem, x: Components) -> None:
    plant = problem.plant
    moved = _values(plant.states, [abs(e) for e in plant.numeric(plant.input_matrix)], x).max(axis=0).reshape(plant.n, plant.m)
    for state, row in zip(problem.states, moved, strict=True):
        for variable, rate in zip(problem.inputs, row, strict=True):
            step, width = rate * max(abs(variable.low), abs(variable.high)) * problem.dt, state.high - state.low
            if step > width:
                warnings.warn(
                    f"{variable.symbol} at the edge of its box [{variable.low:g}, {variable.high:g}] moves {state.symbol} by {step:.4g} in "
                    f"a control period, across its whole workspace [{state.low:g}, {state.high:g}]: check their units",
                    SystemDefinitionWarning,
                    stacklevel=4,
                )


def _at(problem: SafetyProblem, x: Components, i: int) -> str:
    return "(" + ", ".join(f"{s} = {component[i]:.6g}" for s, component in zip(problem.plant.states, x, strict=True)) + ")"
