from __future__ import annotations

import json
import math

import numpy as np
import pytest

from agents.problems import load_problem
from scripts.reproduce import dubins_disk, dubins_learning, quadrotor, store, verdict
from scripts.reproduce.artefact import Outcome, Sample
from scripts.reproduce.learned_runs import over_learnings, runs, thinned
from wrappers import HOCBF

ARTEFACTS = {artefact.name: artefact for artefact in (*dubins_learning.ARTEFACTS, *quadrotor.ARTEFACTS)}
QUICK = Sample(episodes=8, quick=True)


@pytest.fixture(scope="module")
def outcomes():
    return {name: artefact.compute(QUICK) for name, artefact in ARTEFACTS.items()}


def ours(numbers):
    return {number.name: number.ours for number in numbers}


def test_the_module_has_the_figures_of_the_chapter():
    assert list(ARTEFACTS) == ["figure-3.1", "figure-3.2a", "figure-3.2b", "figure-3.3"]


@pytest.mark.parametrize("name", ARTEFACTS)
def test_an_outcome_survives_json(name, outcomes):
    text = json.dumps(outcomes[name].document(), allow_nan=False)
    assert Outcome.from_document(json.loads(text)).document() == json.loads(text)


@pytest.mark.parametrize("name", ARTEFACTS)
def test_an_outcome_is_drawn_and_judged(name, outcomes, tmp_path):
    artefact, outcome = ARTEFACTS[name], outcomes[name]
    store.keep(tmp_path, artefact, QUICK, outcome, 0.0)
    assert (tmp_path / f"{name}.png").stat().st_size > 5000
    assert verdict.judge(artefact, outcome).verdict in verdict.Verdict


@pytest.mark.parametrize("name", ARTEFACTS)
def test_the_same_seed_gives_the_same_outcome(name, outcomes):
    if name == "figure-3.2b":
        dubins_learning.passages.cache_clear()
    if name == "figure-3.3":
        # This one learns anew, too.
        dubins_learning.residuals.cache_clear()
    assert ARTEFACTS[name].compute(QUICK).document() == outcomes[name].document()


@pytest.mark.parametrize("name", ARTEFACTS)
def test_names_of_numbers_are_unique_and_printed_forms_have_one_of_ours(name, outcomes):
    outcome = outcomes[name]
    names = [number.name for number in outcome.numbers]
    assert len(set(names)) == len(names)
    assert {number.name for number in outcome.as_printed} <= set(names)
    for other in outcome.elsewhere.values():
        assert [number.name for number in other.numbers] == names


@pytest.mark.parametrize("name", ARTEFACTS)
def test_curves_are_thinned(name, outcomes):
    def lists(found):
        if isinstance(found, dict):
            return [entry for value in found.values() for entry in lists(value)]
        if isinstance(found, list) and found and isinstance(found[0], dict):
            return [entry for value in found for entry in lists(value)]
        return [found] if isinstance(found, list) else []

    assert max(len(entry) for entry in lists(outcomes[name].data)) <= 400


@pytest.mark.parametrize(("p", "b_1"), [(0.5, -1.35), (1.0, -1.26), (5.0, -0.54)])
def test_the_printed_start_of_the_disk_is_outside_the_kept_set(p, b_1):
    # By hand: h = .18, L_f h = -2 v x = -1.44, L_f^2 h = -2 v^2 = -1.28.
    h, first, second = dubins_disk.chain_at(load_problem(dubins_disk.DISK), p, dubins_disk.PRINTED_START)
    assert h == pytest.approx(0.18)
    assert first == pytest.approx(b_1)
    assert second == pytest.approx(-1.28 - 1.44 * 2 * p + 0.18 * p * p)
    assert dubins_disk.chain_at(load_problem(dubins_disk.DISK), p, dubins_disk.VALID_START)[1] == pytest.approx(0.99 * p)


@pytest.mark.parametrize("p", [0.5, 1.0])
def test_with_a_fine_period_the_exact_filter_follows_the_closed_form(p):
    dt = 0.002
    world = load_problem(dubins_disk.DISK).configured(start=dubins_disk.PRINTED_START, dt=dt, horizon=2.6, box=(-1000.0, 1000.0))
    (run,) = runs(world, [f"hocbf:p={p},{p}"], policy="zero", knowledge="plant")
    time, depth = dubins_disk.crossing(world, p, dubins_disk.PRINTED_START)
    assert dt * int(np.argmax(run.h < 0)) == pytest.approx(time, abs=2 * dt)
    assert run.smallest == pytest.approx(depth, rel=0.02)


def test_the_printed_differences_give_half_of_the_gain():
    problem = load_problem(dubins_disk.DISK).configured(dt=1e-3)
    _, share = dubins_disk.printed_residuals(problem, QUICK, 0)
    assert share == pytest.approx(0.5, abs=1e-3)


def test_the_disk_knows_the_exact_filter_and_the_direction_of_the_error(outcomes):
    outcome = outcomes["figure-3.1"]
    assert not outcome.claims[0].holds
    assert "outside C_2 for every gain" in outcome.notes[0]
    assert "inside C_2 for every gain" in outcome.notes[1]
    printed, corrected = ours(outcome.as_printed), ours(outcome.numbers)
    # Half of the gain makes the filter turn twice as much.
    assert printed["smallest h, p = 0.5"] > corrected["smallest h, p = 0.5"]


def test_the_way_past_the_obstacle_is_longer_at_the_same_speed(outcomes):
    outcome = outcomes["figure-3.2a"]
    found = ours(outcome.numbers)
    assert found["lowest speed, learned"] == pytest.approx(0.8, rel=2e-3)
    assert found["path, true"] > found["path, none"] == pytest.approx(0.8 * found["time to the goal, none"], rel=1e-3)
    assert found["path, none"] > math.dist((-2, -2), dubins_learning.GOAL) - dubins_learning.GOAL_RADIUS
    assert outcome.claims[1].holds


def test_the_nominal_and_the_printed_derivatives_collide_and_the_true_ones_do_not(outcomes):
    outcome = outcomes["figure-3.2b"]
    found, printed = ours(outcome.numbers), ours(outcome.as_printed)
    assert found["smallest h, true"] > 0 > max(found["smallest h, nominal"], found["smallest h, none"])
    assert printed["smallest h, true"] < 0
    assert outcome.claims[1].holds


def test_the_printed_formula_of_the_quadrotor_diverges_and_the_corrected_one_does_not(outcomes):
    outcome = outcomes["figure-3.3"]
    found, printed = ours(outcome.numbers), ours(outcome.as_printed)
    assert found["smallest h, true"] > 0 > found["smallest h, nominal"]
    assert printed["smallest h, true"] < -10
    assert printed["time in the workspace, true"] < 3.0
    assert verdict.judge(ARTEFACTS["figure-3.3"], outcome).wrong_formula


def test_the_printed_row_differs_from_the_derived_one_as_the_errata_say():
    problem = load_problem(quadrotor.QUADROTOR)
    barrier, model = problem.barriers[0], problem.model
    derived, printed = (condition.constraint(model, barrier) for condition in (HOCBF(quadrotor.GAINS), quadrotor.PrintedHOCBF()))
    at = {quadrotor.z: 6.5, quadrotor.zdot: 0.7, **model.parameters}
    assert float((derived.coefficient[0] + printed.coefficient[0]).subs(at)) == pytest.approx(0.0, abs=1e-12)
    cubed, squared = 4 * 1.5**3 / 16, 12 * 1.5**2 / 16
    expected = 2 * cubed * 9.81 - squared * (0.7**2 - 0.7)
    assert float((derived.offset - printed.offset).subs(at)) == pytest.approx(expected)
    assert float((derived.chain[1] - printed.chain[1]).subs(at)) == pytest.approx(0.0, abs=1e-12)


def test_equal_repetitions_have_an_interval_of_no_width():
    number = over_learnings("n", [3.0, 3.0, 3.0], "", 3.0)
    assert (number.low, number.ours, number.high) == (3.0, 3.0, 3.0)
    assert verdict.agrees(number)


def test_thinning_keeps_the_first_value_and_few_others():
    assert thinned(np.arange(5.0)) == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert thinned(np.arange(1001.0))[0] == 0.0
    assert len(thinned(np.arange(1001.0))) <= 400
