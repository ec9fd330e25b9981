"""What the thesis prints, typed a second time, and its formulas against closed forms."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr

from safe_envs import RelativeDegreeError
from safe_envs.agents import NominalController, evaluate, make_problem
from safe_envs.dynamics.lie import derivatives, generator
from safe_envs.wrappers import HOCBF, SZCBF
from thesis import rates
from thesis.artefact import Sample, settings, texts
from thesis.chapter_3 import figure_3_1, figure_3_3, learning
from thesis.chapter_4 import cruise, dubins, example_4_2_2, figure_4_1, figure_4_3, table_4_1
from thesis.chapter_5 import figure_5_1, noise
from thesis.chapter_6 import bayes, table_6_1, table_6_2, table_6_3
from thesis.rates import PrintedCondition, measure

NUMBERS = {
    3: "figure-3.1 figure-3.2a figure-3.2b figure-3.3",
    4: "example-4.2.2 figure-4.1 table-4.1 figure-4.2 figure-4.3",
    5: "figure-5.1 table-5.1 figure-5.2 table-5.2 figure-5.3a figure-5.3b figure-5.3c figure-5.3d",
    6: "figure-6.1 figure-6.2 table-6.1 table-6.2 figure-6.3 figure-6.4 table-6.3 table-6.4",
}

SETTINGS = """
3 disk: rates (0.5, 1.0, 5.0), start (0.9, 0.1, 0.0)
3 obstacle: pauses (0.0, 4.0, 7.0), speed 0.8, obstacle_radius 0.5
3 quadrotor: gains (2.0, 8.0), half_width 2.0
3 learning: epochs 500
4 scalar: gamma 1.0
4 cruise: start (15.0, 20.0, 150.0), noise 1.0, step 0.05, horizon 100.0, episodes 50
4 cruise_assumed: tau 1.8, gamma 1.0, slack_weight 0.02, limit 4855.95
4 cruise_fitted: tau 5.8, gamma 0.0008, slack_weight 0.1, limit 1000.0
4 dubins: radius 3.0, noises (0.0, 0.05, 0.1, 0.15, 0.2), beyond (0.25, 0.3), episodes 1000
4 dubins: points 10, episodes_of_point 500, noise 0.2, horizons (3.0, 5.0, 10.0)
5 learning: points 200, repetitions 50000, episodes 1000
5 pendulum: noise 0.1, threshold 90.0
5 cubic: levels (0.1, 0.15), alpha 2.0, horizon 4.0
6 identification: starts 10, repetitions (10, 30, 100), noise_starts 100, noise_steps 300
6 identification: draws 10000, prior_of_sigma (1.0, 1.0)
6 cubic: points 100, shown 30, episodes 1000, feeble_inputs (0.0, 0.1)
6 car: fresh 100, episodes 1000, generator_points 300, generator_repetitions 10000
"""
"""Chapter, section and values: most of the thesis, some of what it leaves open."""

PRINTED = """
figure-3.1 {'safe_runs': 3}
table-4.1 {'SRCBF, unbounded': 92.0, 'SCBF, unbounded': 80.0, 'SRCBF, bounded': 25.0, 'SCBF, bounded': 70.0}
table-5.1 {'SCBF': 92.0, 'DDSCBF': 91.0, 'CBF': 0.0}
table-5.2 {'SCBF': (86.8, 84.3), 'DDSCBF': (85.2, 83.0), 'CBF': (77.3, 57.5)}
table-6.1 {'f_1': (0.01, 0.002, 0.0006), 'f_2': (0.05, 0.008, 0.0006)}
table-6.2 {'SCBF': (91, 55), 'DDSCBF': (88, 45), 'Bayesian SCBF': (90, 43), 'Analytical': (50, 35)}
table-6.3 {'SCBF': 83, 'DDSCBF': 65, 'Bayesian SCBF': 78}
table-6.4 {'DDSCBF (thesis: more than)': 18000.0, 'Bayesian SCBF': 15.0}
"""  # noqa: E501


def test_what_the_thesis_prints_and_what_is_taken():
    assert list(texts()) == " ".join(NUMBERS.values()).split()
    printed = [f"{name} {text.printed}" for name, text in texts().items() if text.printed]
    assert printed == PRINTED.split("\n")[1:-1]
    for line in SETTINGS.split("\n")[1:-1]:
        place, _, values = line.partition(": ")
        chapter, section = place.split()
        found = vars(settings(int(chapter), section)).items()
        assert set(re.split(r", (?=[a-z])", values)) <= {f"{name} {v}" for name, v in found}, line
    for text in texts().values():
        assert text.title
        assert text.assumptions
        assert text.settings


PLANTS = {
    "DubinsDisk-v0": {"v": 0.8},
    "DubinsObstacle-v0": {"v": 0.8, "v_o": 0.5},
    "QuadrotorAltitude-v0": {"m": 0.6},
    "ACC-v0": {"f_0": 0.1, "f_1": 5.0, "f_2": 0.25, "M": 1650.0},
    "StochasticDubins-v0": {"v": 2.0, "sigma_1": 0.2},
    "CubicSDEDisk-v0": {"sigma_1": 0.2, "sigma_2": 0.2},
    "ACCGap-v0": {"sigma_1": 0.5, "sigma_2": 0.5},
}


@pytest.mark.parametrize("env_id", PLANTS)
def test_the_plants_are_those_of_the_thesis(env_id):
    values = make_problem(env_id).plant.parameter_values
    assert {name: values[name] for name in PLANTS[env_id]} == PLANTS[env_id]


def test_sizes_follow_what_was_asked_for():
    samples = Sample(), Sample(7), Sample(quick=True), Sample(7, quick=True)
    assert [sample.size(1000) for sample in samples] == [1000, 7, 50, 7]
    assert [sample.work(200) for sample in samples] == [200, 200, 10, 10]


# --- chapter 3 ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("p", "b_1"), [(0.5, -1.35), (1.0, -1.26), (5.0, -0.54)])
def test_the_printed_start_of_the_disk_is_outside_the_invariant_set(p, b_1):
    # By hand: h = .18, L_f h = -2 v x = -1.44.
    problem = make_problem(figure_3_1.DISK.env)
    constraint = HOCBF((p, p)).constraint(problem.plant, problem.barriers[0])

    def at(start):
        values = dict(zip(problem.plant.states, start, strict=True))
        return [float(problem.plant.numeric(each).subs(values)) for each in constraint.chain]

    assert at(figure_3_1.DISK.start) == pytest.approx([0.18, b_1])
    assert at(figure_3_1.DISK.valid_start) == pytest.approx([0.99, 0.99 * p])


@pytest.mark.parametrize("p", [0.5, 1.0])
def test_exact_derivatives_follow_the_closed_form_out_of_the_disk(p):
    # While the condition binds, h = (h(0) + b_1(0) t) exp(-p t).
    dt, b_1 = 0.002, -1.44 + 0.18 * p
    problem = make_problem(figure_3_1.DISK.env).configured(
        start=figure_3_1.DISK.start, dt=dt, horizon=2.6, input_bounds=(-1000.0, 1000.0)
    )
    (run,) = learning.runs(problem, [f"hocbf:alpha={p},{p}"], policy="zero", knowledge="plant")
    time = -0.18 / b_1
    assert dt * int(np.argmax(run.h < 0)) == pytest.approx(time, abs=2 * dt)
    assert run.smallest == pytest.approx(b_1 / p * math.exp(-p * time - 1), rel=0.02)


def test_the_printed_differences_give_half_of_the_gain(monkeypatch):
    monkeypatch.setattr(learning, "sizes", lambda _: {"states": 400, "epochs": 1})
    problem = make_problem(figure_3_1.DISK.env).configured(dt=1e-3)
    _, share = figure_3_1.printed_residuals(problem, Sample(quick=True), 0)
    assert share == pytest.approx(0.5, abs=1e-3)


def test_the_printed_hocbf_of_the_quadrotor_differs_as_the_errata_say():
    problem = make_problem("QuadrotorAltitude-v0")
    derived, printed = (
        condition.constraint(problem.model, problem.barriers[0])
        for condition in (HOCBF(figure_3_3.GAINS), PrintedCondition(figure_3_3.printed_hocbf))
    )
    at = {figure_3_3.z: 6.5, figure_3_3.zdot: 0.7, **problem.model.parameters}
    cubed, squared = 4 * 1.5**3 / 16, 12 * 1.5**2 / 16
    assert float((derived.coefficient[0] + printed.coefficient[0]).subs(at)) == pytest.approx(0.0)
    expected = 2 * cubed * 9.81 - squared * (0.7**2 - 0.7)
    assert float((derived.offset - printed.offset).subs(at)) == pytest.approx(expected)
    assert float((derived.chain[1] - printed.chain[1]).subs(at)) == pytest.approx(0.0)


# --- chapter 4 ------------------------------------------------------------------------------------


def test_reciprocal_conditions_allow_the_printed_inputs():
    h = example_4_2_2.DISTANCES
    for text, noise_level in (("rcbf", 0.0), ("srcbf", 0.3)):
        law = h**3 - (1 - h) - noise_level**2 / h
        assert np.allclose(example_4_2_2.largest_inputs(text, noise_level), law, rtol=1e-6)


@pytest.mark.parametrize("start", [0.25, 0.75])
def test_h_over_c_is_attained(start):
    safe = example_4_2_2.safe_up_to
    assert safe(start, 60.0) == pytest.approx(1 - start**2, abs=1e-6)
    # Who looks at the steps only misses some exits.
    assert safe(start, 2.0, 0.01) > safe(start, 2.0) > safe(start, 3.0) > 1 - start**2
    problem = replace(example_4_2_2.attaining_problem(start), horizon=2.0)
    rate = measure(problem, "scbf", 400, 0).rate / 100
    expected = safe(start, 2.0, 0.005)
    assert abs(rate - expected) < 4 * math.sqrt(expected * (1 - expected) / 400)


def test_the_scalar_system_under_the_scbf_is_brownian():
    # With A h = 0, h = 1 - sigma W_t.
    options = {
        "noise": 0.5,
        "start": [0.0],
        "input_bounds": [-1e12, 1e12],
        "dt": 0.005,
        "horizon": 2.5,
    }
    rate = measure("Scalar-v0", "scbf", 400, 0, options=options).rate / 100
    reach = 1 + example_4_2_2.SHIFT * 0.5 * math.sqrt(0.005)
    expected = 1 - 2 * float(ndtr(-reach / (0.5 * math.sqrt(2.5))))
    assert abs(rate - expected) < 4 * math.sqrt(expected * (1 - expected) / 400)


def test_the_force_near_the_edge():
    """At equal speeds SCBF balances the drag, and SRCBF brakes by M tau sigma^2/h more."""
    h, setting = figure_4_1.DISTANCES, cruise.ASSUMED
    drag = 0.1 + 5 * 20.0 + 0.25 * 20.0**2
    excess = (setting.tau * 1.0) ** 2 / h - setting.gamma * h**3
    acting = h < 1.0
    assert np.allclose(figure_4_1.needed_force(setting, "scbf"), drag)
    expected = drag - 1650.0 / setting.tau * excess
    force = figure_4_1.needed_force(setting, f"srcbf:gamma={setting.gamma}")
    assert np.allclose(force[acting], expected[acting], rtol=1e-6)
    for each in (setting, cruise.FITTED):
        turns = figure_4_1.stricter_below(each)
        assert each.tau**2 / turns == pytest.approx(each.gamma * turns**3)


def test_the_goal_of_the_printed_qp():
    """The minimiser of (u^2 + d^2)/2 with a + b u <= d, V = (x_1 - 22)^2."""
    problem = cruise.problem_of(cruise.PRINTED_QP, 1e12)
    for speed in (10.0, 21.9, 30.0):
        drag = 0.1 + 5 * speed + 0.25 * speed**2
        a, b = -2 * (speed - 22) * drag / 1650 + 1.0, 2 * (speed - 22) / 1650
        state = np.array([speed, 20.0, 150.0])
        wanted = NominalController(problem).predict(state)[0][0] * 1e12
        assert wanted == pytest.approx(-b * max(a, 0.0) / (1 + b**2), rel=1e-6)


def test_the_printed_table_4_1_is_out_of_reach():
    unsafe = table_4_1.most_unsafe(cruise.ASSUMED.tau)
    assert unsafe == pytest.approx(2 * ndtr(-(150 - 15 * 1.8) / 18.0))
    assert unsafe < 1e-11
    fitted = table_4_1.most_unsafe(cruise.FITTED.tau)
    assert table_4_1.headway_for(fitted) == pytest.approx(cruise.FITTED.tau)


def test_the_printed_szcbf():
    """Its constraint is the corrected one less alpha_2 (h_1 - h), and lets calm paths out."""
    problem = dubins.problem_of(0.1, "inward")
    barrier, formula = problem.barriers[0], partial(dubins.printed_szcbf, (2.0, 3.0))
    printed, corrected = (
        condition.constraint(problem.model, barrier)
        for condition in (PrintedCondition(formula), SZCBF((2.0, 3.0)))
    )
    h = barrier.expression
    missing = 3 * (generator(problem.model, h) + 2 * h - h)
    assert (corrected.offset - printed.offset - missing).expand().simplify() == 0
    assert printed.coefficient[0].equals(corrected.coefficient[0])
    calm = dubins.simulate(dubins.PRINTED_FORM, 0.0, "inward", 10, 0)
    assert [run.rate().ours for run in calm.values()] == [0.0, 0.0]
    assert dubins.simulate({"SCBF": "scbf"}, 0.0, "inward", 10, 0)["SCBF"].rate().ours == 100.0


def test_violations_are_those_of_an_evaluation():
    found = dubins.simulate({"SCBF": "scbf"}, 0.2, "uniform", 60, 3)["SCBF"]
    problem = dubins.problem_of(0.2, "uniform")
    row = evaluate(problem, "zero", ["scbf"], episodes=60, seed=3, bounds=False).rows[0]
    assert [int(found.safe(time).sum()) for time in row.curve.time] == row.curve.safe
    assert found.infeasible == pytest.approx(row.infeasible_rate)


@pytest.mark.parametrize("kind", ["uniform", "inward"])
def test_random_starts(kind):
    starts = figure_4_3.random_starts(kind, 0)
    x, y, heading = starts.T
    assert starts.shape == (10, 3)
    assert (np.hypot(x, y) < 3.0).all()
    inward = -4 * (x * np.cos(heading) + y * np.sin(heading)) - 2 * 0.2**2 > 0
    assert inward.all() == (kind == "inward")


def test_bounds_of_the_disk_and_where_they_are_contradicted():
    # At (1, 0), headed for the centre, sigma = .2: h = 8, A h = 4 - .08, c = 9 and 12 - .08.
    starts = np.array([[1.0, 0.0, math.pi], [1.0, 0.0, 0.0]])
    product, union = figure_4_3.bounds_at(starts)
    assert product == pytest.approx([8 / 9 * 3.92 / 11.92, 0.0])
    assert union == pytest.approx([8 / 9 + 3.92 / 11.92 - 1, 0.0])
    run = dubins.Violations(np.where(np.arange(200) < 20, 1000, 1), 0.1)
    note = figure_4_3.bound_note([run, run], starts)
    assert "holds at 1 of 2" in note
    assert "at most 29.2 % there, and contradicted at 1 by T = 10 s" in note
    assert "in 10.0 % of the steps" in note


# --- chapter 5 ------------------------------------------------------------------------------------


def test_the_learned_term_has_its_closed_form_and_the_printed_estimator_its_bias():
    sample, theta = Sample(quick=True), np.linspace(-0.4, 0.4, 9)
    assert figure_5_1.pendulum_term(theta) == pytest.approx(-math.sqrt(3) * (0.1 * theta) ** 2)
    assert figure_5_1.cubic_term(0.5) == pytest.approx(-0.0025)
    learned = noise.identifications("safe_envs/Pendulum-v0", 0.1, sample)
    first, repetitions = learned[0], sample.work(50_000)
    angle, speed = first.x.T
    term = -math.sqrt(3) * (0.1 * angle) ** 2
    # The repaired estimate of a quadratic h with one channel of noise has the relative deviation
    # sqrt(2/n).
    score = (first.labels["martingale"] / term - 1.0) / math.sqrt(2.0 / repetitions)
    assert 0.4 < np.sqrt(np.mean(score**2)) < 1.8
    # The printed one has the bias dt/2 f' h_xx f = -dt f' P f.
    f, weights = np.stack([speed, 10.0 / 0.7 * np.sin(angle)]), np.array([[3**0.5, 1], [1, 3**0.5]])
    bias = -0.01 * np.einsum("ip,ij,jp->p", f, weights, f)
    deviation = 0.2 * np.abs(angle) * np.abs(weights[0] @ first.x.T) / (0.01 * repetitions) ** 0.5
    assert np.all(np.abs(first.labels["printed"] - term - bias) < 4.5 * deviation + 1e-4)
    assert np.sqrt(np.mean(bias**2)) > 50 * np.sqrt(np.mean(term**2))
    # Identifications have data of their own.
    assert len({each.seed for each in learned}) == 2
    assert not np.isclose(learned[0].x, learned[1].x).any()


def test_without_noise_there_is_no_gap_between_scbf_and_a_cbf_without_class_k_term():
    options = {"noise": 0.0, "horizon": 0.5}
    cubic = "safe_envs/CubicSDE-v0"
    found = noise.rates_of(cubic, options, Sample(20), [noise.WITHOUT_RATE, "scbf"])
    scbf, without = found["scbf"].row, found[noise.WITHOUT_RATE].row
    assert scbf.safe == without.safe
    assert scbf.min_h_median == pytest.approx(without.min_h_median, rel=1e-6)


# --- chapter 6 ------------------------------------------------------------------------------------

DISK = table_6_2.CUBIC.env


def test_the_error_of_the_drift_is_the_law_for_states_over_the_disk():
    problem = make_problem(DISK)
    x = np.random.default_rng(1).uniform(-0.6, 0.6, (400, 2))
    found = table_6_1.study(problem, x, 10, range(4), 1000, 1)
    # Ten features, sigma = .2, K = 10, R = 1000, dt = .01. Near the centre the errors are smaller
    # than on average over the disk.
    assert 0.3 < found.squares.mean() / (10 * 0.2**2 / (10 * 1000 * 0.01)) < 1.2
    assert 0.7 < found.in_deviations.mean() < 1.3
    expected = found.in_deviations.mean() / math.sqrt(problem.dt)
    assert found.overconfident.mean() == pytest.approx(expected, rel=0.05)


def test_the_printed_generator_of_the_disk_lacks_x_1_x_2():
    problem = make_problem(DISK, start="thesis-1")
    (x_1, x_2), (u,) = problem.plant.states, problem.plant.inputs
    printed = table_6_2.printed_generator(problem)
    _, derived = derivatives(problem.plant, problem.barriers[0].expression, 1, generator)
    derived = problem.plant.numeric(derived) - 2 * x_2**2 * u
    at = {x_1: 0.3, x_2: 0.4, u: 2.0}
    assert float((derived - printed).subs(at)) == pytest.approx(0.12)
    # With it, a constraint by hand gives the same episodes as the condition.
    by_hand = bayes.printed_rate("", problem, printed + x_1 * x_2, 40, 0)
    assert by_hand.ours == pytest.approx(measure(problem, "scbf", 40, 0).rate)


def test_the_printed_second_generator_of_the_car_differs_from_the_derived_one():
    # By hand at v = 15, z = 13: y = z - D = 3, d = v_f - v = 5, F = 0.1 + 75 + 56.25, s = .5.
    problem = make_problem(table_6_3.CAR.env)
    (v, z), (u,) = problem.plant.states, problem.plant.inputs
    found = table_6_3.printed_second_generator(problem).subs({v: 15.0, z: 13.0, u: 100.0})
    force = 131.35
    expected = 5 * 81 / 1650 * force + 20 * 27 * 25 - 81 / 1650 * 100.0 + 120 * 3 * 0.5
    assert float(found) == pytest.approx(expected)


def test_an_identification_without_any_input_is_counted_as_unfiltered(monkeypatch):
    problem = make_problem(DISK, start="thesis-2")

    def blind(*args, learned=(), **how):
        if learned:
            raise RelativeDegreeError("no input")
        return evaluate(*args, **how)

    monkeypatch.setattr(rates, "evaluate", blind)
    models: Any = [None, None]
    found = measure(problem, "bayesian-scbf", 20, 0, models)
    free = evaluate(problem, filters=["none"], episodes=20, bounds=False).rows[0].safety_rate
    assert found.rates == [free, free]
    with pytest.raises(RelativeDegreeError):
        measure("DubinsDisk-v0", "cbf", 2, 0)
