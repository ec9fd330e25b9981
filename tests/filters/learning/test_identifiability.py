"""What data leave open is told, with the names of what is meant."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from safe_envs.filters.learning.bayesian import IdentifiabilityWarning, identify, term_names
from safe_envs.filters.learning.collection import collect, draw_states, plant_step
from safe_envs.filters.learning.data import Signature, Transitions
from safe_envs.filters.learning.models.features import Features
from safe_envs.filters.learning.models.posterior import Posterior
from safe_envs.problem.problem import SafetyProblem
from safe_envs.systems.cubic import cubic_sde, cubic_sde_disk
from safe_envs.systems.quadrotor_altitude import quadrotor_altitude

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


def test_the_one_input_of_the_thesis_does_not_identify_g():
    _, text = told(data=collect(PROBLEM, 200, 10, inputs=[[0.1]]))
    assert "input u stays within [0.1, 0.1]" in text
    assert "cannot tell apart: 1 and u; x_1 and u x_1; x_2 and u x_2" in text
    assert "6 more" in text


def test_no_input_at_all():
    found, text = told(data=collect(PROBLEM, 200, 10, inputs=[[0.0]]))
    assert "u (never excited)" in text
    assert found.pruned.all()


def test_a_state_that_never_varies():
    x = draw_states(PROBLEM, 60, np.random.default_rng(0))
    x[:, 0] = 0.3
    _, text = told(data=data_at(x, (-1.0, 1.0)))
    assert "the state x_1 is always 0.3" in text
    assert "x_2 and x_1 x_2 and x_1^2 x_2" in text


def test_too_few_rows():
    _, text = told(
        data=data_at(draw_states(PROBLEM, 8, np.random.default_rng(0)), (-1.0, 1.0)), degree=3
    )
    assert "16 different rows of data are too few for 20 weights" in text


def test_a_strong_prior_is_all_that_is_known_of_what_the_noise_drowns():
    _, text = told(starts=50, steps=1, repetitions=2, prior=1e-3)
    assert "the noise drowns" in text
    assert "x_1, x_2: " in text


def test_features_that_miss_something():
    _, text = told(starts=400, steps=1, repetitions=400, degree=1)
    assert "x_2: features of degree 1 miss" in text
    assert "x_1: features" not in text


def test_noise_that_varies_with_the_state():
    problem = cubic_sde()
    _, text = told(problem, starts=200, steps=1, repetitions=20)
    assert "x_2: the variance of its noise varies by" in text
    assert "x_1" not in text
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        identify(problem, starts=200, steps=1, repetitions=20, diffusion_degree=2)


def test_names_of_terms():
    features = Features.of(PROBLEM, 2)
    assert term_names(features, ["u"])[:8] == (
        "1",
        "x_1",
        "x_2",
        "x_1^2",
        "x_1 x_2",
        "x_2^2",
        "u",
        "u x_1",
    )
    shifted = Features.of(quadrotor_altitude(), 1)
    assert term_names(shifted, ["U"]) == ("1", "z", "zdot", "U", "U z", "U zdot")
