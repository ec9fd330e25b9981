"""Barriers for held input, and what is proved of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.held_step import HeldStep, held_period
from safe_envs.filters.certificates.matching import plant_of
from safe_envs.proofs.certify import Named, SynthesisSettings
from safe_envs.proofs.held import check_held
from safe_envs.proofs.held_synthesis import SampledStep, certify_held
from safe_envs.proofs.linear_program import ChebyshevBasis, Domain
from safe_envs.registry import make_problem


def test_a_low_degree_proves_a_bound_of_the_scalar_system():
    problem = make_problem("safe_envs/Scalar-v0", horizon=0.2)
    found = certify_held(
        Named(problem, "safe_envs/Scalar-v0", {"horizon": 0.2}), SynthesisSettings(degrees=(4,))
    )
    (attempt,) = found.attempts
    assert 0.7 < attempt.proved <= attempt.sampled + 1e-6
    assert attempt.sampled <= attempt.program + 1e-6
    assert abs(found.mean - attempt.proved) < 0.02
    assert found.certificate is not None
    assert (found.certificate.steps, found.certificate.env_id) == (20, "safe_envs/Scalar-v0")
    assert check_held(found.certificate, 20.0).word == "checked"


@pytest.mark.parametrize("env_id", ["Scalar", "CubicSDE"])
def test_expectations_of_the_basis_are_those_of_the_exact_step(env_id):
    problem = make_problem(f"safe_envs/{env_id}-v0")
    plant = plant_of(problem)
    step = SampledStep(plant, problem.dt)
    domain = Domain.of(plant, (False,) * len(plant.states))
    basis = ChebyshevBasis(plant.states, *step.frame(domain), 4)
    rng = np.random.default_rng(0)
    c = rng.integers(-3, 4, len(basis.exponents)).astype(float)
    x, u = domain.bank[:5], np.linspace(*step.bounds, 5)
    psi = basis.polynomial(c, 3)
    exact = HeldStep(plant, psi, held_period(problem)).expectation(plant.inputs)
    for state, held, value in zip(x, u, step.expected(basis, x, u) @ c, strict=True):
        at = dict(zip((*plant.states, *plant.inputs), (*state, held), strict=True))
        assert float(exact.subs(at)) == pytest.approx(value, abs=1e-9)


def test_no_step_from_the_safe_set_leaves_the_box():
    problem = make_problem("safe_envs/Scalar-v0")
    plant = plant_of(problem)
    (center,), (half,) = SampledStep(plant, problem.dt).frame(Domain.of(plant, (False,)))
    # From x = 1 with u = 10: x + dt (x + u) and nine deviations of .2 sqrt(dt).
    assert 1.0 + 0.11 + 9 * 0.02 < center + half < 1.4


@pytest.mark.parametrize(
    ("env_id", "options", "told"),
    [
        ("Scalar", {"substeps": 2}, "substeps = 2"),
        ("DubinsDisk", {}, "has no noise"),
    ],
)
def test_what_has_no_such_bound(env_id, options, told):
    problem = make_problem(f"safe_envs/{env_id}-v0", **options)
    with pytest.raises(ConfigurationError, match=told):
        certify_held(Named(problem), SynthesisSettings(degrees=(2,)))


def test_several_inputs_or_shared_noise_are_errors():
    plant = plant_of(make_problem("safe_envs/CubicSDE-v0"))
    u = plant.inputs * 2
    with pytest.raises(ConfigurationError, match="2 inputs"):
        SampledStep(replace(plant, inputs=u), 0.01)
    one = sp.Integer(1)
    with pytest.raises(ConfigurationError, match="same noise"):
        SampledStep(replace(plant, diffusion=((one,), (one,))), 0.01)
