"""What is known modulo a period: outputs that are continuous so, and states that repeat."""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.angle_jumps import (
    angle_jumps,
    are_multiples,
    without_remainders,
    words_of,
)
from safe_envs.problem.measurement import Channel

_STATES = 9
"""At which outputs are compared."""


def continuous_output(channel: Channel, model: ControlAffineSDE) -> sp.Expr:
    """Return what a channel measures, as an expression that is continuous modulo its period.

    Args:
        channel: of a sensor.
        model: with the values of the parameters.

    Raises:
        ConfigurationError: It jumps by no multiple of the period.
    """
    expression = model.numeric(channel.expression)
    jumps = angle_jumps(expression)
    if not (channel.period if jumps is None else are_multiples(jumps, channel.period)):
        raise ConfigurationError(
            f"the measurement {channel.name} jumps {words_of(jumps)} after a turn of its angles,"
            f" and its period is {channel.period:g}: an estimator would take the jump for an error"
            " of the state. Give a period of which the jump is a multiple, or leave it out"
        )
    return without_remainders(expression) if channel.period else expression


def periods_of_states(estimator: Any) -> tuple[float, ...]:
    """Return the number modulo which a sensor tells each state; 0 of those that it tells in full.

    A channel a x_i + b of period T tells x_i modulo T/|a|, if all other channels repeat after that.

    Args:
        estimator: an `Estimator`.
    """
    outputs = [continuous_output(c, estimator.model) for c in estimator.measurement.channels]
    found = []
    for i, state in enumerate(estimator.model.states):
        turns = set()
        for channel, output in zip(estimator.measurement.channels, outputs, strict=True):
            slope = sp.simplify(sp.diff(output, state)) if channel.period else sp.S.Zero
            if slope.is_number and slope != 0:
                turns.add(abs(channel.period / float(slope)))
        found.append(next((turn for turn in sorted(turns) if _repeats(estimator, i, turn)), 0.0))
    return tuple(found)


def _repeats(estimator: Any, i: int, turn: float) -> bool:
    """Return whether all that is measured is the same after a turn of a state, at some states."""
    x = list(np.random.default_rng(0).standard_normal((estimator.n, _STATES)))
    turned = [c + turn * (j == i) for j, c in enumerate(x)]
    with np.errstate(all="ignore"):
        before, after = (
            [np.broadcast_to(y, _STATES) for y in estimator.expected("arrays", states)]
            for states in (x, turned)
        )
        differences = estimator.innovations("arrays", after, before, [True] * len(before))
    scales = [abs(y[np.isfinite(y)]).max(initial=0.0) for y in before]
    # What is not finite, as the root of a negative number, tells nothing.
    return not any(
        (abs(d) > 1e-9 * scale).any() for d, scale in zip(differences, scales, strict=True)
    )
