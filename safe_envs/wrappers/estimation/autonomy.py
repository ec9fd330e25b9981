"""What an estimator predicts with: a model and a sensor of the state alone, not of what moves."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, SystemDefinitionError
from safe_envs.problem.measurement import Measurement
from safe_envs.problem.signals import TIME


def require_state_alone(model: ControlAffineSDE, measurement: Measurement) -> None:
    """Raise SystemDefinitionError where a model or a sensor depends on signals or the time.

    Args:
        model: that predicts. Its signals may be in barriers, at which no estimator looks.
        measurement: what is measured.
    """
    for what, symbol in _uses(model, measurement, {*model.signals, TIME}):
        raise SystemDefinitionError(
            f"{what} depends on {'the time' if symbol == TIME else f'the signal {symbol}'}, of"
            " which an estimator knows no value: make it a state, with its rate in the drift (1"
            " for the time). Barriers may hold signals and the time, which the filter is given"
        )


def require_fixed(
    model: ControlAffineSDE, measurement: Measurement, given: Collection[sp.Symbol]
) -> None:
    """Raise ConfigurationError where a model or a sensor depends on what a filter is given.

    Args:
        model: that predicts, with values of its parameters.
        measurement: what is measured.
        given: symbols whose values the filter is given at each call; those of the same names count.
    """
    names = {s.name for s in given}
    known = {p for p in model.parameters if p.name in names}
    for what, symbol in _uses(model, measurement, known):
        raise ConfigurationError(
            f"{what} of the estimator depends on {symbol}, whose value the filter is given at each"
            f" call: the estimator predicts with {symbol} = {model.parameters[symbol]:g} always."
            " Leave it out of adjustable=... and signals, or make it a state"
        )


def _uses(
    model: ControlAffineSDE, measurement: Measurement, symbols: set[Any]
) -> Iterator[tuple[str, Any]]:
    """Return which parts depend on symbols, and on which of them."""
    parts: dict[str, Any] = {
        "the drift": model.drift,
        "the input matrix": model.input_matrix,
        "the diffusion": model.diffusion,
    }
    parts |= {f"the measurement {c.name}": c.expression for c in measurement.channels}
    for what, part in parts.items():
        for symbol in sorted(part.free_symbols & symbols, key=str):
            yield what, symbol
