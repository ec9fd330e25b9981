from __future__ import annotations

import json
import math

import numpy as np
import pytest
from matplotlib.figure import Figure

from safe_envs.agents import make_problem
from safe_envs.scripts.reproduce.chapter_3 import (
    disk_starts,
    dubins_disk,
    dubins_obstacle,
    learned_runs,
    quadrotor,
)
from safe_envs.scripts.reproduce.chapter_3.learned_runs import runs, thinned
from safe_envs.scripts.reproduce.chapter_3.printed_differences import printed_residuals
from safe_envs.scripts.reproduce.framework import store, verdict
from safe_envs.scripts.reproduce.framework.artefact import Findings, Workload
from safe_envs.scripts.reproduce.framework.printed_condition import PrintedCondition
from safe_envs.wrappers import HOCBF

pytestmark = pytest.mark.slow
ARTEFACTS = {
    artefact.name: artefact
    for artefact in (*dubins_disk.ARTEFACTS, *dubins_obstacle.ARTEFACTS, *quadrotor.ARTEFACTS)
}
QUICK = Workload(episodes=8, quick=True)


def compute(name):
    """The quick outcome, of shorter runs in the disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            dubins_disk, "disk", lambda _: make_problem(dubins_disk.DISK).configured(horizon=1.5)
        )
        return ARTEFACTS[name].compute(QUICK)


@pytest.fixture(scope="module")
def outcomes():
    return {name: compute(name) for name in ARTEFACTS}


def ours(numbers):
    return {number.name: number.ours for number in numbers}


def held(claims, word):
    """Whether the only claim with a word in it holds."""
    (claim,) = [claim for claim in claims if word in claim.sentence]
    return claim.holds


def drawn(name, outcome):
    figure = Figure(figsize=ARTEFACTS[name].size)
    ARTEFACTS[name].draw(figure, outcome)
    return figure


def test_the_module_has_the_figures_of_the_chapter():
    assert list(ARTEFACTS) == ["figure-3.1", "figure-3.2a", "figure-3.2b", "figure-3.3"]


def test_settings_and_numbers_are_those_of_the_thesis(outcomes):
    # Sec. 3.5.1, static case, with Eq. (3.27), (3.28).
    world = dubins_disk.disk(Workload())
    assert (world.dt, world.horizon, world.steps) == (0.05, 50.0, 1000)
    assert [system.parameter_values["v"] for system in (world.plant, world.model)] == [0.8, 0.5]
    assert (dubins_disk.RATES, dubins_disk.PRINTED_START) == ((0.5, 1.0, 5.0), (0.9, 0.1, 0.0))
    outcome = outcomes["figure-3.1"]
    assert [n.printed for n in outcome.numbers] == [3, None, None, None]
    assert all(
        [n.printed for n in other.numbers] == [3, None, None, None]
        for other in outcome.alternative_settings.values()
    )
    assert {c["p"] for c in outcome.data["curves"]} == {0.5, 1.0, 5.0}
    # Sec. 3.5.1, moving case, with Fig. 3.2; p_1 = p_2 = 1 are of thesis-notes.
    world = make_problem(dubins_obstacle.OBSTACLE, start="thesis")
    assert [world.plant.parameter_values[name] for name in ("v", "v_o")] == [0.8, 0.5]
    assert [world.model.parameter_values[name] for name in ("v", "v_o")] == [0.5, 0.5]
    instants = outcomes["figure-3.2a"].data["instants"]
    assert [instant["time"] for instant in instants] == [0.0, 4.0, 7.0]
    assert [instants[0][what] for what in ("vehicle", "obstacle")] == [[-2.0, -2.0], [-1.0, 0.0]]
    assert [instant["obstacle"][0] for instant in instants] == pytest.approx([-1.0, 1.0, 2.5])
    assert (
        dubins_obstacle.OBSTACLE_RADIUS,
        dubins_obstacle.SPEED,
        dubins_obstacle.OBSTACLE_RATES,
    ) == (0.5, 0.8, "1,1")
    # Sec. 3.5.2 with Fig. 3.3.
    world = quadrotor.hover(Workload())
    assert [system.parameter_values["m"] for system in (world.plant, world.model)] == [0.6, 0.4]
    assert (quadrotor.GAINS, quadrotor.HALF_WIDTH) == ((2.0, 8.0), 2.0)
    assert outcomes["figure-3.3"].data["true"]["z"][0] == 5.0
    # Sec. 3.5.1, 3.5.2: 500 epochs; the rest is of thesis-notes, and three learnings are ours.
    assert learned_runs.learning_sizes(Workload()) == (2000, 500)
    assert len(learned_runs.seeds(Workload())) == 3


def test_claims_of_the_thesis_are_apart_from_ours(outcomes):
    flags = {
        name: [claim.printed for claim in outcome.claims] for name, outcome in outcomes.items()
    }
    assert flags == {
        "figure-3.1": [True, False],
        "figure-3.2a": [True, True, True, False],
        "figure-3.2b": [True, True, True, False],
        "figure-3.3": [True] * 2,
    }


def test_settings_are_those_of_the_sample():
    for sample, learnings, long in (
        (Workload(), "3 learnings from 2000 states", "50 s;"),
        (QUICK, "2 learnings from 400 states", "2.5 s;"),
    ):
        for artefact in ARTEFACTS.values():
            assert learnings in " ".join(artefact.setting(sample))
        text = " ".join(ARTEFACTS["figure-3.1"].setting(sample))
        assert f"plant 0.8 m/s, model 0.5 m/s, dt 0.05 s, {long} p_1 = p_2 = 0.5, 1, 5 1/s" in text
    assert "up to 20 s" in ARTEFACTS["figure-3.1"].setting(Workload())[-1]
    assert "up to 2.5 s" in ARTEFACTS["figure-3.1"].setting(QUICK)[-1]
    assert "rates from 8 starts" in " ".join(ARTEFACTS["figure-3.2a"].setting(QUICK))
    assert "rates from 1000 starts" in " ".join(ARTEFACTS["figure-3.3"].setting(Workload()))
    assert ARTEFACTS["figure-3.3"].setting(Workload())[0].endswith("30 s")
    assert ARTEFACTS["figure-3.3"].setting(QUICK)[0].endswith("7 s")


def test_what_is_told_of_the_learning_is_so(outcomes):
    for env_id in (dubins_disk.DISK, dubins_obstacle.OBSTACLE, quadrotor.QUADROTOR):
        models = learned_runs.residuals(env_id, QUICK)
        assert len(models) == 2
        told = {"states": 400, "label_dt": 1e-3, "hidden": [100, 30], "epochs": 80}
        assert [model.record.settings for model in models] == [told, told]
    coordinates = [
        list(map(str, make_problem(env_id).sampling_domain.coordinates))
        for env_id in (dubins_disk.DISK, dubins_obstacle.OBSTACLE)
    ]
    assert coordinates == [
        ["x", "y", "cos(theta)", "sin(theta)"],
        ["cos(theta)", "sin(theta)", "-x + x_o", "-y + y_o"],
    ]
    assert make_problem(quadrotor.QUADROTOR).sampling_domain.inputs == ((3.0,), (9.0,))
    for name in ("figure-3.1", "figure-3.2a", "figure-3.2b"):
        assert any("3 inputs; " in line for line in ARTEFACTS[name].errata)
    assert all(
        any("0.001 s" in line for line in artefact.errata) for artefact in ARTEFACTS.values()
    )


@pytest.mark.parametrize("name", ARTEFACTS)
def test_an_outcome_survives_json(name, outcomes):
    text = json.dumps(outcomes[name].document(), allow_nan=False)
    assert Findings.from_document(json.loads(text)).document() == json.loads(text)


@pytest.mark.parametrize("name", ARTEFACTS)
def test_an_outcome_is_drawn_and_judged(name, outcomes, tmp_path, pictures):
    artefact, outcome = ARTEFACTS[name], outcomes[name]
    store.keep(tmp_path, artefact, QUICK, outcome, 0.0)
    assert (tmp_path / f"{name}.png").stat().st_size > 5000
    assert verdict.judge(artefact, outcome, Workload()).verdict in verdict.Verdict


@pytest.mark.parametrize("name", ["figure-3.1", "figure-3.2b", "figure-3.3"])
def test_the_same_seed_gives_the_same_outcome(name, outcomes):
    """One of each module: figure-3.2a shows runs of figure-3.2b, and rates as figure-3.3 does."""
    if name == "figure-3.2b":
        dubins_obstacle.passages.cache_clear()
    if name == "figure-3.3":
        # This one learns again, too.
        learned_runs.residuals.cache_clear()
    assert compute(name).document() == outcomes[name].document()


@pytest.mark.parametrize("name", ARTEFACTS)
def test_names_of_numbers_are_unique_and_printed_forms_have_one_of_ours(name, outcomes):
    outcome = outcomes[name]
    names = [number.name for number in outcome.numbers]
    assert len(set(names)) == len(names)
    assert {number.name for number in outcome.printed_formula} <= set(names)
    for other in outcome.alternative_settings.values():
        assert [number.name for number in other.numbers] == names
        assert [claim.sentence for claim in other.claims] == [
            claim.sentence for claim in outcome.claims if claim.printed
        ]


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
    h, first, second = disk_starts.chain_at(
        make_problem(dubins_disk.DISK), p, dubins_disk.PRINTED_START
    )
    assert h == pytest.approx(0.18)
    assert first == pytest.approx(b_1)
    assert second == pytest.approx(-1.28 - 1.44 * 2 * p + 0.18 * p * p)
    assert second < 0
    assert disk_starts.chain_at(make_problem(dubins_disk.DISK), p, dubins_disk.VALID_START)[
        1
    ] == pytest.approx(0.99 * p)


@pytest.mark.parametrize("p", [0.5, 1.0])
def test_with_a_fine_period_the_exact_filter_follows_the_closed_form(p):
    dt = 0.002
    world = make_problem(dubins_disk.DISK).configured(
        start=dubins_disk.PRINTED_START, dt=dt, horizon=2.6, box=(-1000.0, 1000.0)
    )
    (run,) = runs(world, [f"hocbf:p={p},{p}"], policy="zero", knowledge="plant")
    time, depth = disk_starts.crossing(world, p, dubins_disk.PRINTED_START)
    assert dt * int(np.argmax(run.h < 0)) == pytest.approx(time, abs=2 * dt)
    assert run.smallest == pytest.approx(depth, rel=0.02)


def test_the_printed_differences_give_half_of_the_gain():
    problem = make_problem(dubins_disk.DISK).configured(dt=1e-3)
    _, share = printed_residuals(problem, QUICK, 0)
    assert share == pytest.approx(0.5, abs=1e-3)


def test_exact_derivatives_leave_the_disk_from_the_printed_start_too():
    world = dubins_disk.disk(QUICK).configured(start=(0.9, 0.1, 0.0), box=dubins_disk.WIDE)
    lowest = [
        run.smallest
        for run in runs(world, ["hocbf:p=0.5,0.5", "hocbf:p=1,1"], policy="zero", knowledge="plant")
    ]
    assert max(lowest) < -0.1


def test_other_settings_of_the_disk_are_tried_with_every_learning(outcomes):
    others = outcomes["figure-3.1"].alternative_settings
    assert [
        ("start (0.0, 0.1, 0.0)" in name, "pi" in name, "margin" in name) for name in others
    ] == [(True, False, False), (True, True, False), (False, True, False), (False, False, True)]
    for other in (outcomes["figure-3.1"], *others.values()):
        counts = other.claims[0].evidence.split(" of 3")[0].split(": ")[1].split(", ")
        assert len(counts) == 2
        assert other.numbers[0].ours == min(map(int, counts))


def test_the_disk_knows_the_exact_filter_and_the_direction_of_the_error(outcomes):
    outcome = outcomes["figure-3.1"]
    assert not held(outcome.claims, "All trajectories")
    assert "outside C_2 for every gain" in outcome.notes[0]
    assert "inside C_2 for every gain" in outcome.notes[1]
    printed, corrected = ours(outcome.printed_formula), ours(outcome.numbers)
    # Half of the gain makes the filter turn twice as much.
    assert printed["smallest h, p = 0.5"] > corrected["smallest h, p = 0.5"]


def test_the_way_past_the_obstacle_is_longer_at_the_same_speed(outcomes):
    outcome = outcomes["figure-3.2a"]
    found = ours(outcome.numbers)
    assert found["lowest speed, learned"] == pytest.approx(0.8, rel=2e-3)
    assert (
        found["path, true"]
        > found["path, none"]
        == pytest.approx(0.8 * found["time to the goal, none"], rel=1e-3)
    )
    assert (
        found["path, none"]
        > math.dist((-2, -2), dubins_obstacle.GOAL) - dubins_obstacle.GOAL_RADIUS
    )
    assert held(outcome.claims, "longer")


def test_the_nominal_and_the_printed_derivatives_collide_and_the_true_ones_do_not(outcomes):
    outcome = outcomes["figure-3.2b"]
    found, printed = ours(outcome.numbers), ours(outcome.printed_formula)
    assert (
        found["smallest h, true"] > 0 > max(found["smallest h, nominal"], found["smallest h, none"])
    )
    assert printed["smallest h, true"] < 0
    (at_rest,) = outcome.alternative_settings.values()
    assert (
        ours(at_rest.numbers)["smallest h, nominal"]
        == printed["smallest h, nominal"]
        < found["smallest h, nominal"]
    )
    assert held(outcome.claims, "falls below")
    assert not held(outcome.claims, "slows down")


def test_the_printed_formula_of_the_quadrotor_diverges_and_the_corrected_one_does_not(outcomes):
    outcome = outcomes["figure-3.3"]
    found, printed = ours(outcome.numbers), ours(outcome.printed_formula)
    assert found["smallest h, true"] > 0 > found["smallest h, nominal"]
    assert printed["smallest h, true"] < -10
    assert printed["time in the workspace, true"] < 3.0
    assert verdict.judge(ARTEFACTS["figure-3.3"], outcome, Workload()).wrong_formula
    assert (
        "the state leaves the workspace, of which the altitudes are [0, 10] m, after 1.85 s of 7 s,"
        " at 10.4 m" in outcome.notes[0]
    )


def test_the_band_is_drawn_where_it_is(outcomes):
    (axes,) = drawn("figure-3.3", outcomes["figure-3.3"]).axes
    edges = [float(line.get_ydata()[0]) for line in axes.lines if len(line.get_ydata()) == 2]
    assert edges == [3.0, 7.0]
    areas = [(patch.get_y(), patch.get_y() + patch.get_height()) for patch in axes.patches]
    assert areas == [(1.5, 3.0), (7.0, 8.5)]


def test_the_obstacle_is_drawn_where_it_is(outcomes):
    (axes,) = drawn("figure-3.2a", outcomes["figure-3.2a"]).axes
    places = {(*(round(float(x), 6) for x in patch.center), patch.radius) for patch in axes.patches}
    assert places == {(-1.0, 0.0, 0.5), (1.0, 0.0, 0.5), (2.5, 0.0, 0.5), (3.0, 1.5, 0.3)}
    assert {text.get_text() for text in axes.texts} == {"goal", "0 s", "4 s", "7 s"}


def test_the_printed_row_differs_from_the_derived_one_as_the_errata_say():
    problem = make_problem(quadrotor.QUADROTOR)
    barrier, model = problem.barriers[0], problem.model
    derived, printed = (
        condition.constraint(model, barrier)
        for condition in (HOCBF(quadrotor.GAINS), PrintedCondition(quadrotor.printed_hocbf))
    )
    at = {quadrotor.z: 6.5, quadrotor.zdot: 0.7, **model.parameters}
    assert float((derived.coefficient[0] + printed.coefficient[0]).subs(at)) == pytest.approx(
        0.0, abs=1e-12
    )
    cubed, squared = 4 * 1.5**3 / 16, 12 * 1.5**2 / 16
    expected = 2 * cubed * 9.81 - squared * (0.7**2 - 0.7)
    assert float((derived.offset - printed.offset).subs(at)) == pytest.approx(expected)
    assert float((derived.chain[1] - printed.chain[1]).subs(at)) == pytest.approx(0.0, abs=1e-12)


def test_thinning_keeps_the_first_value_and_few_others():
    assert thinned(np.arange(5.0)) == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert thinned(np.arange(1001.0))[0] == 0.0
    assert len(thinned(np.arange(1001.0))) <= 400
