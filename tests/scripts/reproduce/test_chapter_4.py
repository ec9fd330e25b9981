"""The artefacts of chapter 4: that they run, what is printed, and that they say what closed forms
say."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr

from safe_envs.agents.policies.nominal import NominalController
from safe_envs.dynamics.lie import generator
from safe_envs.problem.barrier import Barrier
from safe_envs.scripts.reproduce.chapter_4 import (
    cruise,
    cruise_effort,
    cruise_setting,
    dubins_noise,
    dubins_points,
    dubins_runs,
    martingale,
    reciprocal_inputs,
)
from safe_envs.scripts.reproduce.framework import store
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Findings, Workload
from safe_envs.scripts.reproduce.framework.printed_condition import PrintedCondition
from safe_envs.scripts.reproduce.framework.verdict import Verdict, judge
from safe_envs.wrappers import SZCBF

pytestmark = pytest.mark.slow
MODULES = (martingale, cruise, cruise_effort, dubins_noise, dubins_points)
ARTEFACTS = {a.name: a for module in MODULES for a in module.ARTEFACTS}
QUICK = Workload(quick=True)
BROWNIAN_HORIZON = 2.5
"""Of the rates with closed forms, in s: long enough for noise to make a fifth of the episodes
unsafe."""
_found: dict[str, Findings] = {}


def outcome_of(name: str) -> Findings:
    """The quick outcome of shorter episodes, computed once."""
    if name not in _found:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(martingale, "HORIZON", BROWNIAN_HORIZON)
            patch.setattr(cruise_setting, "HORIZON", 25.0)
            patch.setattr(dubins_runs, "HORIZONS", (3.0, 5.0))
            patch.setattr(dubins_noise, "NOISES", (0.0, 0.2))
            patch.setattr(dubins_points, "POINTS", 3)
            _found[name] = ARTEFACTS[name].compute(QUICK)
    return _found[name]


def ours(name: str) -> dict[str, Any]:
    """Numbers of an outcome by name."""
    return {number.name: number for number in outcome_of(name).numbers}


@pytest.fixture(params=list(ARTEFACTS))
def artefact(request: pytest.FixtureRequest) -> Artefact:
    """Each one."""
    return ARTEFACTS[request.param]


def test_what_the_thesis_prints() -> None:
    """Every number and setting of the thesis, typed a second time."""
    # Sec. 4.2.2: "we choose gamma = 1".
    assert reciprocal_inputs.GAMMA == 1.0
    # thesis-notes, "Closed forms": the shift by watching at steps only.
    assert martingale.SHIFT == 0.5826
    # Table 4.1: 92 and 80 % unbounded, 25 and 70 % bounded, of 50 trajectories.
    assert {n.name: (n.printed, n.printed_trials) for n in outcome_of("table-4.1").numbers} == {
        "SRCBF, unbounded": (92.0, 50),
        "SCBF, unbounded": (80.0, 50),
        "SRCBF, bounded": (25.0, 50),
        "SCBF, bounded": (70.0, 50),
    }
    # Sec. 4.3.1 and the caption of Table 4.1: the start, sigma_1 = 1, steps of .05 s, 100 s, 50
    # trajectories.
    problem = cruise_setting.ASSUMED.problem(1000.0)
    assert (cruise_setting.START, cruise_setting.NOISE, problem.dt, problem.horizon) == (
        (15.0, 20.0, 150.0),
        1.0,
        0.05,
        100.0,
    )
    assert cruise_setting.EPISODES == 50
    values = {symbol.name: value for symbol, value in problem.plant.parameters.items()}
    assert values == {"f_0": 0.1, "f_1": 5.0, "f_2": 0.25, "M": 1650.0, "sigma_1": 1.0}
    # Sec. 4.3.2: v = 2, r = 3, SCBF up to .3, both up to .2 with 1000 starts; ten starts with 500
    # trajectories at sigma = .2.
    assert (min(dubins_noise.NOISES), max(dubins_noise.NOISES), max(dubins_noise.BEYOND)) == (
        0.0,
        0.2,
        0.3,
    )
    assert (
        dubins_noise.EPISODES,
        dubins_points.POINTS,
        dubins_points.EPISODES_OF_POINT,
        dubins_points.NOISE,
    ) == (1000, 10, 500, 0.2)
    vehicle = dubins_runs.dubins_problem(0.2, "uniform")
    assert {s.name: value for s, value in vehicle.plant.parameters.items()} == {
        "v": 2.0,
        "sigma_1": 0.2,
        "sigma_2": 0.2,
    }
    x, y, theta = vehicle.plant.states
    assert vehicle.barriers[0].expression.subs({x: 3, y: 0, theta: 0}) == 0
    # thesis-notes, "What chapters 3 and 4 leave open".
    assert (
        cruise_setting.ASSUMED.tau,
        cruise_setting.ASSUMED.gamma,
        cruise_setting.ASSUMED.slack_weight,
    ) == (1.8, 1.0, 0.02)
    fitted = cruise_setting.FITTED
    assert (fitted.tau, fitted.slack_weight, fitted.rate, fitted.gamma, fitted.limit) == (
        5.8,
        0.1,
        5.0,
        8e-4,
        1000.0,
    )
    assert list(dubins_runs.ALPHAS.values()) == [(1.0, 1.0), (0.5, 0.5)]
    assert dubins_runs.HORIZONS == (3.0, 5.0, 10.0)


@pytest.mark.parametrize(
    ("name", "full"),
    [
        ("example-4.2.2", 2000),
        ("figure-4.1", 50),
        ("table-4.1", 50),
        ("figure-4.2", 1000),
        ("figure-4.3", 500),
    ],
)
def test_settings_say_what_is_simulated(name: str, full: int) -> None:
    """The number of episodes by the sample, and a quick table's control period."""
    for sample, episodes in (
        (Workload(), full),
        (Workload(episodes=7), 7),
        (QUICK, max(full // 20, 10)),
    ):
        assert any(line.endswith(f": {episodes}") for line in ARTEFACTS[name].setting(sample))
    assert ("0.2 s" in ARTEFACTS[name].setting(QUICK)[0]) == (name == "table-4.1")


def test_goes_through_json_and_is_judged(artefact: Artefact) -> None:
    """An outcome is the same after it was written and read, and its claims elsewhere are those of
    the main setting."""
    outcome = outcome_of(artefact.name)
    document = json.loads(json.dumps(outcome.document(), allow_nan=False))
    again = Findings.from_document(document)
    assert again.document() == document
    assert judge(artefact, again, Workload()) == judge(artefact, outcome, Workload())
    names = [number.name for number in outcome.numbers]
    assert len(set(names)) == len(names)
    assert {number.name for number in outcome.printed_formula} <= set(names)
    for other in outcome.alternative_settings.values():
        assert [claim.sentence for claim in other.claims if claim.printed] == [
            claim.sentence for claim in outcome.claims if claim.printed
        ]


@pytest.mark.usefixtures("pictures")
def test_is_drawn(artefact: Artefact, tmp_path: Path) -> None:
    """A figure becomes a picture, without warnings."""
    store.keep(tmp_path, artefact, QUICK, outcome_of(artefact.name), 0.0)
    assert (tmp_path / f"{artefact.name}.png").exists() == (artefact.draw is not None)


def test_same_seed_same_outcome(artefact: Artefact, monkeypatch: pytest.MonkeyPatch) -> None:
    """The seed is all that is random; shown on short episodes."""
    monkeypatch.setattr(martingale, "HORIZON", 0.2)
    monkeypatch.setattr(cruise_setting, "HORIZON", 3.0)
    monkeypatch.setattr(dubins_runs, "HORIZONS", (0.4,))
    monkeypatch.setattr(dubins_noise, "NOISES", (0.0, 0.2))
    monkeypatch.setattr(dubins_noise, "BEYOND", (0.3,))
    monkeypatch.setattr(dubins_points, "POINTS", 2)
    first, second = (artefact.compute(Workload(episodes=4, quick=True)) for _ in range(2))
    assert first.document() == second.document()


def test_printed_inequalities() -> None:
    """u <= h^3 - x and u <= h^3 - x - sigma^2/h."""
    h = reciprocal_inputs.DISTANCES
    assert np.allclose(reciprocal_inputs.largest_inputs("rcbf", 0.0), h**3 - (1 - h), rtol=1e-6)
    assert np.allclose(
        reciprocal_inputs.largest_inputs("srcbf", 0.3), h**3 - (1 - h) - 0.09 / h, rtol=1e-6
    )


def test_bound_is_attained() -> None:
    """P(safe for ever) = 1 - x_0^2, and what is simulated is near the form for its horizon and
    step."""
    for start in martingale.STARTS:
        assert martingale.safe_up_to(start, 60.0) == pytest.approx(1 - start**2, abs=1e-6)
        assert martingale.safe_up_to(start, 1.0) > martingale.safe_up_to(start, 2.0) > 1 - start**2
        # Who looks at the steps only misses some exits.
        assert martingale.safe_up_to(start, 2.0, 0.01) > martingale.safe_up_to(start, 2.0)
        number = ours("example-4.2.2")[f"SCBF where h/c is attained, x_0 = {start:g}"]
        expected = martingale.safe_up_to(start, BROWNIAN_HORIZON, martingale.STEP)
        assert abs(number.ours / 100 - expected) < 4 * math.sqrt(expected * (1 - expected) / 100)


def test_scalar_system_under_scbf_is_brownian() -> None:
    """With A h = 0, h = 1 - sigma W_t."""
    reach = 1 + martingale.SHIFT * reciprocal_inputs.NOISE * math.sqrt(martingale.STEP)
    expected = 1 - 2 * float(ndtr(-reach / (reciprocal_inputs.NOISE * math.sqrt(BROWNIAN_HORIZON))))
    rate = ours("example-4.2.2")["SCBF, unbounded"].ours / 100
    assert abs(rate - expected) < 4 * math.sqrt(expected * (1 - expected) / 100)


def test_force_near_the_edge() -> None:
    """At equal speeds SCBF balances the drag, and SRCBF brakes by M tau sigma^2/h more, which turns
    round at the h of the note."""
    h, setting = cruise_effort.DISTANCES, cruise_setting.ASSUMED
    drag = 0.1 + 5 * cruise_effort.NEAR + 0.25 * cruise_effort.NEAR**2
    asked = drag - 1650.0 / setting.tau * (
        (setting.tau * cruise_setting.NOISE) ** 2 / h - setting.gamma * h**3
    )
    acting = h < 1.0
    assert np.allclose(cruise_effort.needed(setting, "scbf"), drag)
    assert np.allclose(cruise_effort.needed(setting, "srcbf")[acting], asked[acting], rtol=1e-6)
    for each in (setting, cruise_setting.FITTED):
        assert (each.tau * cruise_setting.NOISE) ** 2 / each.stricter_below == pytest.approx(
            each.gamma * each.stricter_below**3
        )


def test_printed_program() -> None:
    """The minimiser of (u^2 + d^2)/2 with a + b u <= d, V = (x_1 - 22)^2."""
    problem = cruise_setting.PRINTED_QP.problem(cruise_setting.UNBOUNDED)
    for speed in (10.0, 21.9, 30.0):
        drag = 0.1 + 5 * speed + 0.25 * speed**2
        a, b = -2 * (speed - 22) * drag / 1650 + 1.0, 2 * (speed - 22) / 1650
        wanted = (
            NominalController(problem).predict(np.array([speed, 20.0, 150.0]))[0][0]
            * cruise_setting.UNBOUNDED
        )
        assert wanted == pytest.approx(-b * max(a, 0.0) / (1 + b**2), rel=1e-6)


def test_printed_table_is_out_of_reach_of_the_default() -> None:
    """The Gaussian law, its inverse, and the simulation agree."""
    assert cruise_setting.ASSUMED.most_unsafe == pytest.approx(2 * ndtr(-(150 - 15 * 1.8) / 18.0))
    assert f"at most {cruise_setting.ASSUMED.most_unsafe:.1g}," in ARTEFACTS["table-4.1"].argument
    assert cruise.headway_for(cruise_setting.FITTED.most_unsafe) == pytest.approx(
        cruise_setting.FITTED.tau
    )
    assert ours("table-4.1")["SCBF, unbounded"].ours == 100.0
    assert judge(ARTEFACTS["table-4.1"], outcome_of("table-4.1"), Workload()).verdict in (
        Verdict.ALTERNATIVE,
        Verdict.NOT,
    )


def test_the_fitted_setting_is_told_as_such() -> None:
    """Where it is named, and in a note."""
    outcome = outcome_of("table-4.1")
    assert any(
        "fitted by us, 4 printed numbers by 5 quantities" in name
        for name in outcome.alternative_settings
    )
    assert any("fitted 4 numbers by 5 quantities, tau = 5.8 s" in note for note in outcome.notes)
    assert any(
        "fitted to Table 4.1, not to this figure" in name
        for name in outcome_of("figure-4.1").alternative_settings
    )


def test_effort_over_time_depends_on_what_the_thesis_leaves_open() -> None:
    """SRCBF's is the lower one most of the time, and the higher one with the settings that were
    fitted to the table."""
    outcome = outcome_of("figure-4.1")
    by_print, fitted = outcome.alternative_settings.values()
    assert [found.claims[0].holds for found in (outcome, by_print, fitted)] == [False, False, True]


def test_printed_zeroing_form() -> None:
    """The printed row is the corrected one less alpha_2 (h_1 - h), and lets paths without noise
    out."""
    problem = dubins_runs.dubins_problem(0.1, "inward")
    barrier: Barrier = problem.barriers[0]
    printed, corrected = (
        condition.constraint(problem.model, barrier)
        for condition in (
            PrintedCondition(partial(dubins_runs.printed_szcbf, (2.0, 3.0))),
            SZCBF((2.0, 3.0)),
        )
    )
    h = barrier.expression
    missing = 3 * (generator(problem.model, h) + 2 * h - h)
    assert (corrected.offset - printed.offset - missing).expand().simplify() == 0
    assert printed.coefficient[0].equals(corrected.coefficient[0])
    printed_formula = {number.name: number for number in outcome_of("figure-4.2").printed_formula}
    for name in dubins_runs.ALPHAS:
        assert printed_formula[f"{name}, sigma = 0"].ours == 0.0
        assert ours("figure-4.2")[f"{name}, sigma = 0"].ours > 50.0


def test_starts_without_condition_are_the_main_setting() -> None:
    """No number is from starts with A h > 0, from which no path without noise leaves."""
    assert ours("figure-4.2")["SCBF, sigma = 0"].ours < 90.0
    assert any(
        name.startswith("starts with A h > 0")
        for name in outcome_of("figure-4.2").alternative_settings
    )
    assert {"SCBF, sigma = 0.25", "SCBF, sigma = 0.3"} <= ours("figure-4.2").keys()


@pytest.mark.parametrize("kind", ["uniform", "inward"])
def test_random_starts(kind: str) -> None:
    """Ten different starts in the disk, with A h > 0 or without that."""
    starts = dubins_runs.random_starts(kind, 0.2, 10, 0)
    x, y, heading = starts.T
    assert starts.shape == (10, 3)
    assert (np.hypot(x, y) < dubins_runs.RADIUS).all()
    assert (-4 * (x * np.cos(heading) + y * np.sin(heading)) - 2 * 0.2**2 > 0).all() == (
        kind == "inward"
    )
    assert not np.array_equal(starts, dubins_runs.random_starts(kind, 0.2, 10, 1))
