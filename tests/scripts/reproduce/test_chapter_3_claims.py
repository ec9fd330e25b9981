"""Claims and numbers of chapter 3 from made-up runs: each can hold, and can fail."""

from __future__ import annotations

import math

import numpy as np
import pytest

from safe_envs.agents import make_problem
from safe_envs.scripts.reproduce.chapter_3 import dubins_disk, dubins_obstacle, quadrotor
from safe_envs.scripts.reproduce.chapter_3.learned_runs import Trajectory
from safe_envs.scripts.reproduce.framework import verdict
from safe_envs.scripts.reproduce.framework.artefact import Findings, Workload

GOAL = (3.0, 1.5)
OBSTACLE = make_problem(dubins_obstacle.OBSTACLE)


def run_with(*h, at=(0.0, 0.0), lengths=()):
    """A made-up run: its barrier, and its way along x from a point."""
    x = at[0] + np.concatenate([[0.0], np.cumsum(lengths or [0.0] * (len(h) - 1))])
    return Trajectory(np.stack([x, np.full(len(h), at[1])], axis=1), np.array(h, dtype=float))


def held(claims, word):
    """Whether the only claim with a word in it holds."""
    (claim,) = [claim for claim in claims if word in claim.sentence]
    return claim.holds


def runs_of_the_disk(*counts):
    """Made-up learnings, of which so many trajectories of 3 are safe each."""
    return [[run_with(1.0, 0.1 if i < safe else -0.1) for i in range(3)] for safe in counts]


def passage(learned=(1.0, 0.2), nominal=(1.0, -0.1), end=(3.0, 1.5), lengths=None, unfiltered=None):
    """Made-up ways past the obstacle of at least one control period, which end where they are told
    to, at .8 m/s unless told otherwise."""
    lengths = lengths or [0.04] * (len(learned) - 1)
    way = run_with(*learned, at=(end[0] - sum(lengths), end[1]), lengths=lengths)
    none = run_with(1.0, -0.1, at=GOAL, lengths=[unfiltered or 0.02])
    return {"learned": [way, way], "nominal": [run_with(*nominal, at=GOAL)], "none": [none]}


@pytest.mark.parametrize(
    ("counts", "ours"),
    [((1, 2, 2), 1), ((0, 0, 3), 0), ((2, 2, 2), 2), ((3, 3, 2), 2), ((3, 3, 3), 3)],
)
def test_all_are_safe_if_they_are_so_in_every_learning(counts, ours):
    number = dubins_disk.disk_numbers(runs_of_the_disk(*counts), 3)[0]
    claim = dubins_disk.all_safe(runs_of_the_disk(*counts))
    assert number.ours == ours
    assert (verdict.disagreement(number) is None) is claim.holds is (ours == 3)
    assert f"{', '.join(map(str, counts))} of 3" in claim.evidence


def test_the_printed_differences_give_the_print_if_all_are_safe_in_every_learning():
    failed = runs_of_the_disk(1, 1, 1)
    outcome = Findings(dubins_disk.disk_numbers(failed, 3), [dubins_disk.all_safe(failed)])
    for counts, same in (((3, 3, 3), True), ((3, 3, 2), False)):
        found = Findings(
            outcome.numbers,
            outcome.claims,
            printed_formula=dubins_disk.disk_numbers(runs_of_the_disk(*counts)),
        )
        judged = verdict.judge(dubins_disk.ARTEFACTS[0], found, Workload())
        assert (judged.wrong_formula, judged.matches_thesis) == (True, same)


@pytest.mark.parametrize(
    ("learned", "nominal", "holds"), [(3, 0, True), (2, 0, False), (3, 1, False)]
)
def test_the_theory_of_the_disk_can_fail(learned, nominal, holds):
    claim = dubins_disk.theory_holds(runs_of_the_disk(3, learned), runs_of_the_disk(nominal)[0])
    assert claim.holds is holds
    assert not claim.printed


@pytest.mark.parametrize(
    ("word", "changed"),
    [
        ("avoids", {"learned": (1.0, -0.01)}),
        ("goal", {"end": (3.0, 1.81)}),
        ("collides", {"nominal": (1.0, 0.01)}),
        ("longer", {"lengths": [0.039]}),
        ("longer", {"unfiltered": 0.05}),
    ],
)
def test_each_claim_about_the_way_can_fail(word, changed):
    assert held(dubins_obstacle.passage_claims(passage(), OBSTACLE), word)
    assert not held(dubins_obstacle.passage_claims(passage(**changed), OBSTACLE), word)


@pytest.mark.parametrize(
    ("word", "good", "bad"),
    [
        ("always positive", {}, {"learned": (1.0, -0.01)}),
        ("falls below", {}, {"nominal": (1.0, 0.01)}),
        ("more time steps", {"learned": (1.0, 0.2, 0.2)}, {"learned": (1.0, 0.2)}),
        ("slows down", {"lengths": [0.039]}, {"lengths": [0.04]}),
    ],
)
def test_each_claim_about_the_barrier_can_hold_and_fail(word, good, bad):
    assert held(dubins_obstacle.clearance_claims(passage(**good), OBSTACLE), word)
    assert not held(dubins_obstacle.clearance_claims(passage(**bad), OBSTACLE), word)


def test_claims_hold_only_if_they_do_in_every_learning():
    fine, worse = passage(), passage((1.0, -0.01), end=(9.0, 9.0))
    mixed = {**fine, "learned": [fine["learned"][0], worse["learned"][0]]}
    for claims, words in (
        (dubins_obstacle.passage_claims, ("avoids", "goal")),
        (dubins_obstacle.clearance_claims, ("always positive",)),
    ):
        assert not any(held(claims(mixed, OBSTACLE), word) for word in words)
    steps = {**fine, "learned": [passage((1.0, 0.2, 0.2))["learned"][0], fine["learned"][0]]}
    assert not held(dubins_obstacle.clearance_claims(steps, OBSTACLE), "more time steps")
    slow = {**fine, "learned": [passage(lengths=[0.039])["learned"][0], fine["learned"][0]]}
    assert not held(dubins_obstacle.clearance_claims(slow, OBSTACLE), "slows down")
    assert not held(dubins_obstacle.passage_claims(slow, OBSTACLE), "longer")


def test_a_turn_at_full_speed_is_no_slowing_down():
    # A chord of an arc of .04 m that turns by pi/20.
    arc = math.pi * 0.05
    chord = 2 * 0.8 / math.pi * math.sin(arc / 2)
    for length, slower in ((chord, False), (chord - 1e-6, True)):
        assert (
            held(
                dubins_obstacle.clearance_claims(passage(lengths=[length]), OBSTACLE), "slows down"
            )
            is slower
        )


def test_what_becomes_of_a_run_is_told_as_it_is():
    problem = quadrotor.hover(Workload(quick=True))
    whole = [0.5] * (problem.steps + 1)
    assert quadrotor.fate(run_with(*whole), problem) == "smallest h 0.5; h stays at 0 or above"
    assert "h < 0 from t = 0.1 s" in quadrotor.fate(
        run_with(0.5, 0.5, -0.5, at=(5.0, 0.0)), problem
    )


@pytest.mark.parametrize(
    ("nominal", "learned", "holds"),
    [(-0.1, 0.1, [True, True]), (0.1, 0.1, [False, True]), (-0.1, -0.1, [True, False])],
)
def test_each_claim_about_the_altitude_can_fail(nominal, learned, holds):
    found = {
        "nominal": [run_with(1.0, nominal)],
        "learned": [run_with(1.0, 0.1), run_with(1.0, learned)],
    }
    assert [claim.holds for claim in quadrotor.altitude_claims(found)] == holds
