"""The condition of a certificate of held input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.files import save_certificate
from safe_envs.filters.certificates.held_step import HeldStep
from safe_envs.wrappers import Certified, SafetyFilter, parse_conditions, spec_of
from tests.conftest import problem_of
from tests.filters.certificates.held_examples import SCALAR, scalar_certificate
from tests.oracles.filter_cases import check


@pytest.fixture(scope="module")
def safety_filter() -> SafetyFilter:
    return SafetyFilter.for_problem(problem_of(SCALAR), Certified(scalar_certificate()))


@pytest.fixture
def psi_file(tmp_path):
    path = tmp_path / "psi.json"
    save_certificate(scalar_certificate(), path)
    return path


def test_its_actions_meet_the_chord_constraint(safety_filter: SafetyFilter) -> None:
    certificate = scalar_certificate()
    x = np.linspace(-1.2, 0.99, 301)[:, None]
    u = np.random.default_rng(0).uniform(-15.0, 15.0, (len(x), 1))
    found = safety_filter.filter(x, u)
    step = HeldStep(certificate.plant, certificate.psi, certificate.period)
    a, b = sp.lambdify(certificate.plant.states, step.constraint(certificate.shortfall))(x[:, 0])
    known = (certificate.psi.values(x) > 0.0) & (abs(x[:, 0]) < 1.25)
    np.testing.assert_array_equal(found.feasible, known)
    left = a * found.action[:, 0] + b
    assert left[known].min() > -1e-12
    np.testing.assert_allclose(found.margin[known].ravel(), left[known], atol=1e-12)
    idle = found.action[:, 0] == u[:, 0]
    assert 0.1 < idle[known].mean() < 0.95
    # Next to the top of psi no input is at its bound by force; at the edge it is.
    assert (abs(found.action[~known]) == 10.0).all()


def test_programs_decide_as_the_filter_does(safety_filter: SafetyFilter) -> None:
    x = np.random.default_rng(2).uniform(-1.5, 1.5, (150, 1))
    u = np.random.default_rng(1).uniform(-15.0, 15.0, (len(x), 1))
    assert check(safety_filter, x, u, most=8) == {"idle", "met", "missed"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dt": 0.02}, r"the control period \(0.01 s in place of 0.02 s\)"),
        ({"substeps": 2}, "substeps = 2"),
        ({"noise": 0.0}, "Runge and Kutta"),
        ({"noise": 0.3}, "the noise"),
    ],
)
def test_another_step_is_refused(options, message, psi_file) -> None:
    with pytest.raises(ConfigurationError, match=message):
        parse_conditions(f"certified:file={psi_file}", problem_of(SCALAR, **options))


def test_one_policy_gives_no_constraint() -> None:
    certificate = scalar_certificate()
    plant = replace(certificate.plant, policy=(sp.Integer(-10),))
    with pytest.raises(ConfigurationError, match="of one policy with held input"):
        Certified(replace(certificate, plant=plant))


@pytest.mark.parametrize("env_id", [SCALAR, "safe_envs/CubicSDEDisk-v0"])
def test_the_text_names_the_kept_certificate(env_id) -> None:
    problem = problem_of(env_id)
    (condition,) = parse_conditions("certified:control=held", problem)
    assert isinstance(condition, Certified)
    assert spec_of(condition) == "certified:control=held"
    assert condition.certificate.env_id == env_id
    for text in ("certified:control=helt", "certified:control=held:file=psi.json"):
        with pytest.raises(ConfigurationError, match="control=held or control=continuous"):
            parse_conditions(text, problem)
    with pytest.raises(ConfigurationError, match="of held input"):
        parse_conditions("certified:control=held", problem_of("safe_envs/Pendulum-v0"))


def test_a_file_says_itself_which_it_is(psi_file) -> None:
    (condition,) = parse_conditions(f"certified:file={psi_file}", problem_of(SCALAR))
    assert condition == Certified(scalar_certificate(), str(psi_file))
    assert "sha256" in spec_of(Certified(scalar_certificate()))
