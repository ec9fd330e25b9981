"""What data leave open is told, with the names of the terms and states."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from safe_envs.filters.learning.bayesian import IdentifiabilityWarning, identify
from safe_envs.filters.learning.collection import collect, draw_states, plant_step
from safe_envs.filters.learning.data import Signature, Transitions
from safe_envs.filters.learning.models.posterior import Posterior
from safe_envs.problem.problem import SafetyProblem
from safe_envs.systems.cubic import cubic_sde, cubic_sde_disk

PROBLEM = cubic_sde_disk()


def told(problem: SafetyProblem = PROBLEM, **arguments) -> tuple[Posterior, str]:
    with pytest.warns(IdentifiabilityWarning) as caught:
        found = identify(problem, **arguments)
    assert tuple(str(w.message) for w in caught) == found.record.warnings
    return found, "\n".join(found.record.warnings)


def data_at(x: np.ndarray, levels: tuple[float, ...], repetitions: int = 5) -> Transitions:
    """Transitions from given states (B, 2) under some inputs."""
    rows, u = np.repeat(x, len(levels), axis=0), np.tile(levels, len(x))[:, None]
    step, rng = plant_step(PROBLEM), np.random.default_rng(1)
    successors = np.stack([step(rows, u, rng) for _ in range(repetitions)], axis=1)
    return Transitions(Signature.of(PROBLEM), rows, u, successors, np.array(PROBLEM.dt))


def test_inputs_of_both_signs_are_enough():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert identify(PROBLEM, starts=200, steps=1, repetitions=10).record.warnings == ()


STILL = draw_states(PROBLEM, 60, np.random.default_rng(0)) * [0.0, 1.0] + [0.3, 0.0]
FEW = draw_states(PROBLEM, 8, np.random.default_rng(0))
LEFT_OPEN = {
    "one input": (
        lambda: {"data": collect(PROBLEM, 200, 10, inputs=[[0.1]])},
        ("input u stays within", "1 and u; x_1 and u x_1; x_2 and u x_2", "6 more"),
    ),
    "no input": (lambda: {"data": collect(PROBLEM, 200, 10, inputs=[[0.0]])}, ("never excited",)),
    "a state that never varies": (
        lambda: {"data": data_at(STILL, (-1.0, 1.0))},
        ("the state x_1 is always 0.3", "x_2 and x_1 x_2 and x_1^2 x_2"),
    ),
    "few rows": (
        lambda: {"data": data_at(FEW, (-1.0, 1.0)), "degree": 3},
        ("16 different rows of data are too few for 20 weights",),
    ),
    "what the noise drowns": (
        lambda: {"starts": 50, "steps": 1, "repetitions": 2, "prior": 1e-3},
        ("the noise drowns", "x_1, x_2: "),
    ),
    "features that miss something": (
        lambda: {"starts": 400, "steps": 1, "repetitions": 400, "degree": 1},
        ("x_2: features of degree 1 miss",),
    ),
}


@pytest.mark.parametrize("name", LEFT_OPEN)
def test_what_the_data_leave_open_is_named(name):
    arguments, parts = LEFT_OPEN[name]
    found, text = told(**arguments())
    assert all(part in text for part in parts)
    assert "x_1: features" not in text
    assert name != "no input" or found.pruned.all()


def test_noise_that_varies_with_the_state():
    problem = cubic_sde()
    _, text = told(problem, starts=200, steps=1, repetitions=20)
    assert "x_2: the variance of its noise varies by" in text
    assert "x_1" not in text
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        identify(problem, starts=200, steps=1, repetitions=20, diffusion_degree=2)
