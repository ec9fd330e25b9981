"""A walk on a line with tasks, and its values by quadrature on a fine grid."""

from __future__ import annotations

import functools

import numpy as np
import sympy as sp
from scipy.special import ndtr

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.filters.specification import Automaton
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.problem.starts import Start

x, wall, u = sp.symbols("x wall u", real=True)

NOISE, PERIOD, STEPS = 0.5, 0.1, 16
SPEED = 0.2
"""Of the wall."""

_WIDTH = 0.005
_EDGES = np.arange(-3.0, 3.0 + _WIDTH / 2, _WIDTH)
POINTS = 0.5 * (_EDGES[:-1] + _EDGES[1:])
"""States of the quadrature; the workspace is [-1, 1]."""

WITHIN = np.abs(POINTS) < 1.0


def walk(*, moves: bool = False, goal: bool = True) -> SafetyProblem:
    """Build dx = u dt + .5 dW, safe above a wall at -.8, with regions left and right of 0.

    Args:
        moves: whether the wall goes to the right, at a speed of .2.
        goal: whether the episode ends at .7.
    """
    states, edge = (x,), sp.Float(-0.8)
    variables: tuple[Variable, ...] = (Variable(x, -1.0, 1.0),)
    drift, matrix, noise, start = [0], [[1]], [NOISE], (0.0,)
    if moves:
        states, edge = (x, wall), wall
        variables += (Variable(wall, -5.0, 5.0),)
        drift, matrix, noise, start = [0, SPEED], [[1], [0]], [NOISE, 0], (0.0, -0.8)
    system = ControlAffineSDE(
        states=states,
        inputs=(u,),
        drift=drift,
        input_matrix=sp.Matrix(matrix),
        diffusion=sp.Matrix(noise),
        parameters={},
    )
    return SafetyProblem(
        name="Walk",
        plant=system,
        model=system,
        barriers=(Barrier(x - edge),),
        regions={
            "left": sp.Rational(4, 100) - (x + sp.Rational(4, 10)) ** 2,
            "right": sp.Rational(4, 100) - (x - sp.Rational(4, 10)) ** 2,
        },
        goal=x - sp.Rational(7, 10) if goal else None,
        states=variables,
        inputs=(Variable(u, -2.0, 2.0),),
        reward=sp.Integer(0),
        nominal=(sp.Integer(0),),
        starts={"middle": Start.at(start)},
        dt=PERIOD,
        horizon=STEPS * PERIOD,
    )


def labels_of(automaton: Automaton, k: int, moves: bool) -> np.ndarray:
    """Return the labels of `POINTS` at an instant."""
    edge = -0.8 + (SPEED * PERIOD * k if moves else 0.0)
    inside = {
        "safe": edge < POINTS,
        "goal": POINTS >= 0.7,
        "left": np.abs(POINTS + 0.4) <= 0.2,
        "right": np.abs(POINTS - 0.4) <= 0.2,
    }
    return automaton.label([inside[name] for name in automaton.atoms])


INPUTS = np.linspace(-2.0, 2.0, 17)


def exact_values(
    automaton: Automaton, *, moves: bool = False, goal: bool = True, leaving: str = "violation"
) -> np.ndarray:
    """Return V_k(x, a) of the walk where an episode goes on, shape (K + 1, points, states)."""
    return _programmed(automaton, moves, goal, leaving)[0]


def worst_inputs(automaton: Automaton, *, moves: bool = False, goal: bool = True) -> np.ndarray:
    """Return the inputs after which the least can be attained, shape (K, points, states)."""
    return _programmed(automaton, moves, goal, "violation")[1]


@functools.cache
def _kernel() -> np.ndarray:
    """Return probabilities of next points, by input and point within the workspace."""
    means = POINTS[WITHIN][None, :, None] + PERIOD * INPUTS[:, None, None]
    return np.diff(ndtr((_EDGES - means) / (NOISE * np.sqrt(PERIOD))), axis=2).astype(np.float32)


def _programmed(
    automaton: Automaton, moves: bool, goal: bool, leaving: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return V_k(x, a), and the inputs with the least expected value after them."""
    ended = ~WITHIN | ((POINTS >= 0.7) & goal)
    states = np.arange(automaton.size)
    accepted = np.broadcast_to(automaton.accepting.astype(float), (len(POINTS), automaton.size))
    last = accepted.copy()
    if leaving == "violation":
        last[~WITHIN] = 0.0
    values, worst = [last], np.zeros((STEPS, *last.shape))
    for k in reversed(range(STEPS)):
        labels = labels_of(automaton, k + 1, moves)
        following = automaton.step(k + 1, states, labels[:, None])
        onward = np.take_along_axis(values[0], following, axis=1)
        found = np.where(ended[:, None], accepted, 0.0)
        if leaving == "violation":
            found[~WITHIN] = 0.0
        expected = (_kernel() @ onward.astype(np.float32)).astype(float)
        worst[k, WITHIN] = INPUTS[expected.argmin(axis=0)]
        rows = expected.max(axis=0)
        found[WITHIN] = np.where(ended[WITHIN][:, None], accepted[WITHIN], rows)
        # What is settled before the workspace is left, counts.
        found[np.ix_(WITHIN, automaton.verdict(k, states) == 1)] = 1.0
        values.insert(0, found)
    return np.array(values), worst


def place_of(x: np.ndarray) -> np.ndarray:
    """Return which of `POINTS` are nearest to states."""
    return np.clip(np.floor((x + 3.0) / _WIDTH).astype(int), 0, len(POINTS) - 1)
