"""The condition of a barrier certificate: its constraint, where it has none, and whose it is."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs import Barrier, ControlAffineSDE, define_problem
from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates import kept
from safe_envs.filters.certificates.files import save_certificate
from safe_envs.filters.conditions.syntax import files_of, with_absolute_paths
from safe_envs.filters.torch_layer import TorchFilter
from safe_envs.proofs.guarantees import no_bound
from safe_envs.proofs.safe_set import Formulas
from safe_envs.testing import check_condition
from safe_envs.wrappers import (
    SZCBF,
    Certified,
    Condition,
    SafetyFilter,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    condition_names,
    parse_condition,
    parse_conditions,
    spec_of,
)
from tests.conftest import problem_of
from tests.filters.certificates.handmade import (
    certificate_of,
    polynomial_of,
    random_polynomial,
)
from tests.oracles.filter_cases import check

DISK = problem_of("safe_envs/CubicSDEDisk-v0")
PENDULUM = problem_of("safe_envs/Pendulum-v0")
x_1, x_2 = DISK.plant.states
H = 1 - x_1**2 - x_2**2
INNER = sp.Rational(1, 4) - x_1**2 - x_2**2  # positive in a smaller disk only


def filter_of(problem, psi, **numbers) -> SafetyFilter:
    return SafetyFilter.for_problem(problem, Certified(certificate_of(problem, psi, **numbers)))


def states_of(problem, count, reach=1.2, seed=0):
    rng = np.random.default_rng(seed)
    high = np.array([v.high for v in problem.states])
    return rng.uniform(-reach * high, reach * high, (count, problem.plant.n))


@pytest.fixture(scope="module")
def psi_file(tmp_path_factory):
    """A file with the certificate of the disk whose psi is h."""
    path = tmp_path_factory.mktemp("certificates") / "psi.json"
    numbers = {"shortfall": ".0801", "supremum": "1.0001"}  # With room for the judge.
    save_certificate(certificate_of(DISK, H, **numbers), path)
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of certificates that are part of the package, which is empty."""
    monkeypatch.setattr(kept, "FOLDER", tmp_path)
    return tmp_path


# the constraint


def correlated():
    """A problem whose two noises act on both states, one of them more where x_1 is larger."""
    u, w = sp.symbols("u w", real=True)
    system = ControlAffineSDE(
        (x_1, x_2),
        (u, w),
        [x_2, -sp.sin(x_1)],
        [[1, x_2], [0, 2]],
        [[0.3, 0.2 * x_1], [0.1, -0.4]],
    )
    return define_problem(
        system,
        1 - x_1**2,
        input_bounds=(-5.0, 5.0),
        start=(0.0, 0.0),
        dt=0.01,
        horizon=1.0,
        workspace={x_1: (-2.0, 2.0), x_2: (-2.0, 2.0)},
    )


@pytest.mark.parametrize(("problem", "degree"), [(DISK, 9), (PENDULUM, 6), (correlated(), 5)])
def test_the_constraint_is_the_generator_of_psi_by_finite_differences(problem, degree):
    system, psi = problem.plant, random_polynomial(problem, degree)
    safety_filter = filter_of(problem, psi, rate=".7", shortfall=".3")
    (constraint,) = safety_filter.constraints
    states = states_of(problem, 60, reach=0.4)
    rng = np.random.default_rng(1)
    inputs = rng.uniform(-5.0, 5.0, (len(states), system.m))

    def values(expressions):
        numbers = [system.numeric(e) for e in expressions]
        return stacked(compile_function(system.states, numbers, "arrays")(*states.T), len(states))

    found = values([*constraint.coefficient, constraint.offset])
    flow = values(system.drift) + np.einsum(
        "bij,bj->bi", values(system.input_matrix).reshape(-1, system.n, system.m), inputs
    )
    sigma = values(system.diffusion).reshape(len(states), system.n, -1)
    step = 1e-3

    def moved(direction):
        return [psi.values(states + k * step * direction) for k in (-2, -1, 0, 1, 2)]

    rate = np.dot([1, -8, 0, 8, -1], moved(flow)) / (12 * step)
    for j in range(sigma.shape[2]):
        rate += np.dot([-1, 16, -30, 16, -1], moved(sigma[:, :, j])) / (24 * step**2)
    expected = rate + 0.7 * psi.values(states) + 0.3
    given = (found[:, :-1] * inputs).sum(axis=1) + found[:, -1]
    np.testing.assert_allclose(given, expected, rtol=1e-6, atol=1e-6 * abs(expected).max())


@pytest.mark.parametrize("scale", [1, "3/10"])
def test_with_h_for_psi_it_is_the_szcbf(scale):
    theirs = SafetyFilter.for_problem(DISK, SZCBF((0.05,)))
    ours = filter_of(DISK, polynomial_of(DISK, H, scale), rate=".05")
    x = states_of(DISK, 400, reach=0.45)
    u = np.random.default_rng(1).uniform(-15.0, 15.0, (len(x), 1))
    inside = (x**2).sum(axis=1) < 1.0
    found, expected = ours.filter(x, u), theirs.filter(x, u)
    assert inside.sum() > 200
    np.testing.assert_allclose(found.action[inside], expected.action[inside], rtol=1e-9)
    np.testing.assert_allclose(found.margin[inside], expected.margin[inside], atol=1e-9)
    np.testing.assert_array_equal(found.feasible[inside], expected.feasible[inside])
    np.testing.assert_array_equal(found.active[inside], expected.active[inside])
    assert 0.5 < found.feasible[inside].mean() < 1.0
    assert not found.feasible[~inside].any()


def test_a_shortfall_and_a_margin_move_the_constraint_by_themselves():
    plain, short = filter_of(DISK, H), filter_of(DISK, H, shortfall=".3")
    margin = SafetyFilter.for_problem(DISK, Certified(certificate_of(DISK, H), sampling_margin=0.3))
    x, u = [0.3, 0.4], [2.0]
    at = plain.filter(x, u)
    assert at.active[0]
    assert short.filter(x, at.action).margin == pytest.approx(at.margin + 0.3)
    assert margin.filter(x, [-10.0]).margin == pytest.approx(plain.filter(x, [-10.0]).margin - 0.3)


# where there is none


@pytest.mark.parametrize(
    ("state", "u"),
    [
        ([0.6, 0.6], -10.0),  # psi < 0 in C
        ([0.6, -0.6], -10.0),  # x_2 u is what moves psi
        ([0.5, 0.0], 3.0),  # psi = 0, where the input does nothing: as proposed
        ([3.0, 0.5], -10.0),  # outside the workspace
        ([1e200, -1e-3], -10.0),
        ([-1e308, 1e308], -10.0),
    ],
)
def test_without_a_constraint_the_action_raises_psi_fastest_and_is_flagged(state, u):
    safety_filter = filter_of(DISK, INNER)
    # What is missing of the inequality, at the nearest state of the workspace.
    first, second = np.clip(state, -2.0, 2.0)
    rate = -2 * first * (-0.6 * first - second) - 2 * second * (first**3 + second * u) - 0.08
    several = safety_filter.decide_arrays(
        tuple(np.array([c, 0.1]) for c in state), (np.array([3.0, 0.0]),)
    )
    for found in (safety_filter.decide_floats(state, [3.0]), several):
        first_of = [np.ravel(part)[0] for part in (found.action, found.margin, found.slack)]
        assert first_of[0] == u
        assert first_of[1] == pytest.approx(rate)
        assert first_of[2] == pytest.approx(max(0.0, -rate))
        assert not np.ravel(found.feasible)[0]
        assert np.ravel(found.active)[0]
    assert several.feasible.tolist() == [False, True]


def test_where_psi_is_positive_outside_c_there_is_none_either():
    safety_filter = filter_of(DISK, 9 - x_1**2 - x_2**2)
    states = [[0.9, 0.0], [1.1, 0.0], [0.9, 1.0]]
    assert safety_filter.filter(states, [[0.0]] * 3).feasible.tolist() == [True, False, False]


def test_every_state_has_a_finite_action_within_the_bounds():
    psi = random_polynomial(DISK, 16)
    safety_filter = filter_of(DISK, psi)
    rng = np.random.default_rng(0)
    x = rng.choice([-1, 1], (300, 2)) * 10.0 ** rng.uniform(-320, 308, (300, 2))
    x[:100] = states_of(DISK, 100)
    u = rng.uniform(-30.0, 30.0, (len(x), 1))
    found = safety_filter.decide_arrays(tuple(x.T), tuple(u.T))
    for part in (*found.action, *found.margin, *found.slack):
        assert np.isfinite(part).all()
    assert (abs(found.action[0]) <= 10.0).all()
    outside = (abs(x) >= 2.0).any(axis=1) | (psi.values(x.clip(-2, 2)) <= 0)
    assert not found.feasible[outside].any()
    assert found.feasible.any()
    for i in range(0, len(x), 3):
        one = safety_filter.decide_floats(x[i].tolist(), u[i].tolist())
        assert one.feasible == found.feasible[i]
        assert one.action[0] == pytest.approx(found.action[0][i], abs=1e-6)
        assert one.slack[0] == pytest.approx(found.slack[0][i], rel=1e-9, abs=1e-9)


def test_an_angle_counts_by_its_turn():
    problem = problem_of("safe_envs/DubinsDisk-v0")
    theta = problem.plant.states[2]
    certificate = certificate_of(problem, 1 - theta**2)
    turn = tuple(
        (-sp.pi, sp.pi) if s == theta else ends
        for s, ends in zip(problem.plant.states, certificate.plant.workspace, strict=True)
    )
    certificate = replace(certificate, plant=replace(certificate.plant, workspace=turn))
    safety_filter = SafetyFilter.for_problem(problem, Certified(certificate), knowledge="plant")
    x = np.array([[0.1, 0.2, 0.5]]) + np.array([[0.0, 0.0, 2 * np.pi * k] for k in (0, 1, -3)])
    found = safety_filter.filter(x, np.full((3, 1), 3.0))
    assert found.feasible.all()
    np.testing.assert_allclose(found.action, found.action[:1].repeat(3, axis=0), atol=1e-12)
    assert found.active.all()
    assert check(safety_filter, x, np.full((3, 1), 3.0)) == {"met"}


# several barriers


def test_several_barriers_get_the_same_constraint():
    both = replace(DISK, barriers=(DISK.barriers[0], Barrier(2 - x_1, "wall")), gains=((1.0,),) * 2)
    condition = Certified(certificate_of(both, INNER))
    safety_filter = SafetyFilter.for_problem(both, condition)
    first, second = safety_filter.constraints
    assert (second.coefficient, second.offset) == (first.coefficient, first.offset)
    alone = SafetyFilter(
        both.model, [(both.barriers[0], condition)], input_bounds=both.input_bounds
    )
    x, u = states_of(DISK, 40, reach=0.3), np.random.default_rng(1).uniform(-15.0, 15.0, (40, 1))
    found, expected = safety_filter.filter(x, u), alone.filter(x, u)
    np.testing.assert_array_equal(found.feasible, expected.feasible)
    np.testing.assert_allclose(found.action, expected.action, atol=1e-9)
    assert expected.active.any()
    assert expected.feasible.any()
    # Other conditions may join it.
    assert SafetyFilter.for_problem(both, [condition, parse_condition("hocbf", (3.0, 2.0))])


# all that a filter goes through


def test_programs_decide_as_the_filter_does():
    safety_filter = filter_of(DISK, random_polynomial(DISK, 5), rate=1)
    x = np.concatenate([states_of(DISK, 200, reach=0.5), states_of(DISK, 30)])
    u = np.random.default_rng(1).uniform(-15.0, 15.0, (len(x), 1))
    assert check(safety_filter, x, u, most=8) == {"idle", "met", "missed"}


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["numpy", pytest.param("compiled", marks=pytest.mark.oracle)])
def test_an_evaluation_keeps_the_bound_of_its_certificate(psi_file, engine):
    name = f"certified:file={psi_file}"
    found = evaluate("safe_envs/CubicSDEDisk-v0", "random", [name], episodes=100, engine=engine)
    (row,) = found.rows
    assert row.filter == name
    assert row.intervention_rate > 0
    # A certificate that the judge proves has its bound, and the filter keeps it.
    assert row.continuous_word == "proved"
    assert 0.0 < row.continuous_bound <= row.ci_high


def test_wrappers_take_its_text(psi_file):
    text = f"certified:file={psi_file}"
    env = SafetyFilterWrapper(gym.make("safe_envs/CubicSDEDisk-v0"), text)
    _, info = env.reset(seed=0, options={"state": [0.3, 0.4]})
    assert info["feasible"]
    *_, info = env.step(np.array([1.0]))
    assert info["feasible"]
    assert info["intervention"]
    batch = SafetyFilterVectorWrapper(gym.make_vec("safe_envs/CubicSDEDisk-v0", 3), text)
    batch.reset(seed=0)
    *_, info = batch.step(np.ones((3, 1), dtype=np.float32))
    assert info["feasible"].shape == (3,)


def test_conditions_are_checked_by_the_same_program_as_those_of_others(psi_file):
    check_condition(f"certified:file={psi_file}", DISK, samples=60)


def test_a_verification_says_that_its_bound_is_another(psi_file):
    conditions = parse_conditions(f"certified:file={psi_file}", DISK)
    (condition,) = conditions
    assert condition.stochastic
    assert condition.chain_rates(2) is None
    formulas = Formulas(DISK, conditions, "model")
    assert "that of the certificate" in no_bound(formulas)
    # The set that is kept is where h and psi are positive.
    np.testing.assert_allclose(formulas.chain(np.array([[0.3, 0.4]])), [[0.75, 0.75]])
    still = replace(DISK, plant=DISK.plant.with_parameters(sigma_1=0.0, sigma_2=0.0))
    still = replace(still, model=still.plant)
    found = Formulas(still, [Certified(certificate_of(still, H))], "model")
    assert "that of the certificate" in no_bound(found)


def test_a_torch_layer_refuses_it():
    with pytest.raises(ConfigurationError, match="of a certificate"):
        TorchFilter(filter_of(DISK, H))


# whose it is


@pytest.mark.parametrize(
    ("options", "differing"),
    [
        ({"noise": 0.3}, "the noise"),
        ({"plant": {"a": 0.61}, "model": {"a": 0.61}}, "the drift"),
        ({"input_bounds": (-9.0, 10.0)}, "the bounds of u"),
        ({"barrier": {"radius": 1.1}}, "the workspace of x_1, the workspace of x_2, the barriers"),
    ],
)
def test_a_certificate_of_another_problem_is_refused(options, differing, psi_file):
    problem = problem_of("safe_envs/CubicSDEDisk-v0", **options)
    for attempt in (
        lambda: parse_conditions(f"certified:file={psi_file}", problem),
        lambda: SafetyFilter.for_problem(problem, Certified(certificate_of(DISK, H))),
    ):
        with pytest.raises(ConfigurationError) as error:
            attempt()
        assert f"of another problem; they differ in {differing}." in str(error.value)
        assert "safe-envs certify" in str(error.value)


def test_a_certificate_of_the_plant_needs_a_filter_that_knows_it():
    problem = problem_of("safe_envs/CubicSDEDisk-v0", model={"sigma_1": 0.0})
    condition = Certified(certificate_of(problem, H))
    assert SafetyFilter.for_problem(problem, condition, knowledge="plant")
    with pytest.raises(ConfigurationError, match=r"this filter knows; they differ in the noise\."):
        SafetyFilter.for_problem(problem, condition)


def test_a_barrier_that_it_is_not_of_is_refused():
    with pytest.raises(ConfigurationError, match="not of the barrier"):
        SafetyFilter(
            DISK.model,
            [(Barrier(2 - x_1), Certified(certificate_of(DISK, H)))],
            input_bounds=DISK.input_bounds,
        )


def test_states_of_other_names_are_told():
    with pytest.raises(ConfigurationError, match=r"the states and inputs \(x_1, x_2, u in place"):
        SafetyFilter.for_problem(PENDULUM, Certified(certificate_of(DISK, H)))


# those of the package


def test_the_certificate_of_the_package_is_taken_where_the_problem_is_its_own(folder):
    ours = certificate_of(DISK, H, shortfall=".08")
    quiet = problem_of("safe_envs/CubicSDEDisk-v0", noise=0.1)
    save_certificate(certificate_of(quiet, INNER), folder / "CubicSDEDisk-v0-noise=0.1.json")
    with pytest.raises(ConfigurationError, match=r"for other options, and differs in the noise"):
        parse_conditions("certified", DISK)
    save_certificate(ours, folder / "CubicSDEDisk-v0.json")
    (found,) = parse_conditions("certified", DISK)
    assert found.certificate == ours
    assert spec_of(found) == "certified"
    assert parse_conditions("certified", quiet)[0].certificate.psi == polynomial_of(quiet, INNER)
    assert spec_of(Certified(certificate_of(DISK, INNER))).startswith("certified:sha256=")
    with pytest.raises(ConfigurationError, match="this package has none of this problem"):
        parse_conditions("certified", PENDULUM)


def test_an_env_without_a_certificate_is_told_what_to_run(folder):
    with pytest.raises(ConfigurationError, match=r"none of CubicSDEDisk.*safe-envs certify"):
        parse_conditions("certified", DISK)


def test_every_certificate_of_the_package_is_of_its_env():
    for path in sorted(kept.FOLDER.glob("*.json")):
        certificate = kept.load_certificate(path)
        problem = problem_of(certificate.env_id, **certificate.options)
        assert kept.kept_certificate(problem) == certificate


# its text


def test_its_text_makes_it_again(psi_file, monkeypatch):
    text = f"certified:file={psi_file}:sampling_margin=0.1"
    conditions = parse_conditions(text, DISK)
    assert spec_of(conditions) == text
    assert parse_conditions(spec_of(conditions), DISK) == conditions
    assert hash(conditions[0]) == hash(parse_conditions(text, DISK)[0])
    assert files_of(text) == (psi_file,)
    monkeypatch.chdir(psi_file.parent)
    assert with_absolute_paths("certified:file=psi.json") == f"certified:file={psi_file.resolve()}"
    assert "certified" in condition_names()


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("certified:file=", "cannot be read"),
        ("certified:file=nowhere.json", "nowhere.json"),
        ("certified:p=2", "'p'"),
        ("certified:certificate=psi.json", "'certificate'"),
        ("certified:sha256=0123", "save it"),
        ("certified:control=held", "--closed-loop"),
        ("certified:file={file}:file={file}", "'file' twice"),
        ("certified:file={file}:sampling_margin=first-order", "first order"),
        ("certified:file={file}:sampling_margin=-1", "sampling_margin"),
        ("certified:file={file}+certified:file={file}", "2 conditions"),
        ("certifed", "'certified'"),
    ],
)
def test_malformed_texts_are_refused(text, fragment, psi_file, folder):
    with pytest.raises(ConfigurationError) as error:
        parse_conditions(text.format(file=psi_file), DISK)
    assert fragment in str(error.value)


def test_without_a_problem_there_is_no_certificate(psi_file):
    for text in ("certified", f"certified:file={psi_file}"):
        with pytest.raises(ConfigurationError, match="needs a certificate"):
            parse_condition(text, (1.0,))
    with pytest.raises(ConfigurationError, match="give a BarrierCertificate"):
        Certified("psi.json")  # pyright: ignore[reportArgumentType]
    assert issubclass(Certified, Condition)
