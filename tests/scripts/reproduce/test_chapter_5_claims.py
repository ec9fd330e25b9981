"""The claims and notes of chapter 5 follow from what they are given, and can say no."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.scripts.reproduce.chapter_5 import (
    cubic,
    cubic_paths,
    noise_terms,
    paired_rates,
    pendulum,
)
from safe_envs.scripts.reproduce.framework.artefact import Workload
from safe_envs.scripts.reproduce.framework.paired import (
    MeasuredFilter,
    difference,
    safer,
    with_interval,
)
from safe_envs.scripts.reproduce.framework.verdict import Verdict, judge


def made(*safe, episodes=1000):
    """Runs in which the first so many episodes are safe, a number for each identification; or which
    ones, where an array is given."""
    flags = [np.arange(episodes) < each if isinstance(each, int) else each for each in safe]
    safe, trials = int(np.sum(flags)), len(flags) * episodes
    low, high = rate_interval(round(safe / len(flags)), episodes)
    counts = {"safe": safe, "episodes": trials, "violations": trials - safe}
    row: Any = SimpleNamespace(**counts, safety_rate=safe / trials, ci_low=low, ci_high=high)
    return MeasuredFilter(row, [float(np.mean(each)) for each in flags], flags, episodes)


def test_a_root_mean_square_has_the_interval_of_its_mean_square():
    number = noise_terms.root_mean_square("", np.sqrt([1.0, 3.0] * 50))
    half = 1.96 * math.sqrt(100 / 99) / 10
    assert (number.ours, number.low, number.high) == pytest.approx(
        tuple(map(math.sqrt, (2.0, 2.0 - half, 2.0 + half)))
    )


def test_claims_about_a_learned_term_can_fail():
    grid = np.linspace(-1.0, 1.0, 21)
    assert noise_terms.as_derived("", -(grid**2), -(grid**2)).holds
    assert not noise_terms.as_derived("", -(grid**2), -1.001 * grid**2).holds
    truth = -(grid**2)  # rms .49, about its mean .32
    assert noise_terms.learnable([0.1, 0.1, 0.1], truth).holds
    assert not noise_terms.learnable(
        [0.1, 0.3, 0.1], truth
    ).holds  # in the mean, but not by more than chance
    assert not noise_terms.learnable([0.4, 0.4, 0.4], truth).holds
    assert noise_terms.near([0.04, 0.05], truth).holds
    assert not noise_terms.near([0.05, 0.05], truth).holds
    assert not noise_terms.near([0.05, 0.05], truth).printed


def pendulum_outcome(scbf=920, ddscbf=910, cbf=0, quiet=1000):
    runs = {
        "scbf": made(scbf),
        "ddscbf": made(ddscbf),
        pendulum.B.cbf: made(cbf),
        pendulum.WITHOUT: made(900),
    }
    return pendulum.outcome_of(pendulum.B, runs, made(quiet))


@pytest.mark.parametrize(
    ("of", "failed"),
    [
        ({}, []),
        ({"cbf": 1}, ["every trajectory"]),
        ({"quiet": 0}, ["the noise"]),
        ({"quiet": 3}, ["the noise"]),  # no more than chance
        ({"ddscbf": 900, "scbf": 905}, ["DDSCBF is safe in more than 90 %"]),
        ({"ddscbf": 901, "scbf": 905}, []),
        ({"scbf": 940}, ["DDSCBF is as safe"]),
        ({"scbf": 880}, ["DDSCBF is as safe"]),
    ],
)
def test_claims_about_the_pendulum_can_fail(of, failed):
    found = [claim for claim in pendulum_outcome(**of).claims if not claim.holds]
    assert len(found) == len(failed)
    assert all(
        claim.sentence.startswith(sentence) for claim, sentence in zip(found, failed, strict=True)
    )
    # What the thesis does not say counts for no verdict.
    assert all(claim.printed != claim.sentence.startswith("DDSCBF is as safe") for claim in found)


def test_the_print_itself_is_reproduced_in_the_pendulum_table():
    assert (
        judge(pendulum.ARTEFACTS[1], pendulum_outcome(), Workload()).verdict == Verdict.REPRODUCED
    )


def test_the_page_says_what_the_other_setting_would_have_given():
    assert pendulum.in_other_setting(pendulum_outcome()).endswith("in A: all as in the thesis")
    said = pendulum.in_other_setting(pendulum_outcome(ddscbf=870, cbf=40))
    assert "DDSCBF: 91 % printed, 87 % here" in said
    assert "CBF: 0 % printed, 4 % here" in said
    assert "it does not hold that every trajectory is unsafe with the CBF" in said


def test_what_the_print_could_resolve():
    assert paired_rates.resolution(50.0, 50.0) == pytest.approx(196 * math.sqrt(0.5 / 1000))
    assert paired_rates.resolution(92.0, 91.0) > 92.0 - 91.0
    assert paired_rates.resolution(77.3, 57.5) < 77.3 - 57.5


def test_differences_are_of_pairs_and_of_identifications():
    def apart(first, second):
        return difference("", first.flags, second.flags)

    half = np.arange(1000) < 500
    assert with_interval(apart(made(600), made(500)), " points") == "+10.0 points [8.1, 11.9]"
    # As many one way as the other: the difference is none, though no episode ends alike.
    none = apart(made(half), made(~half))
    assert (none.ours, none.low < -5.0, none.high > 5.0) == (0.0, True, True)
    repeated = apart(made(500, 600, 700), made(500))
    assert repeated.ours == pytest.approx(10.0)
    assert repeated.low < -10.0  # identifications differ by more than their mean does from none
    assert not safer("", made(500, 600, 700), made(500)).holds
    assert safer("", made(600), made(500)).holds
    assert not safer("", made(500), made(600)).holds
    assert not safer("", made(503), made(500)).holds


def test_closeness_needs_the_whole_interval_within_the_limit():
    def holds(ddscbf, scbf):
        return paired_rates.close({"ddscbf": made(ddscbf), "scbf": made(scbf)}, 92.0, 91.0).holds

    assert holds(910, 910)
    assert not holds(890, 910)  # 2 points, but perhaps more than 2.4
    assert not holds(910, 890)


def cubic_levels(ddscbf):
    return {
        k: {"scbf": made(850), "ddscbf": made(each), cubic.CBF: made(770)}
        for k, each in zip(cubic.LEVELS, ddscbf, strict=True)
    }


@pytest.mark.parametrize(
    ("ddscbf", "holds"),
    [((850, 850), [1, 1, 1, 1]), ((770, 890), [0, 0, 0, 1]), ((850, 771), [1, 0, 1, 0])],
)
def test_claims_about_the_cubic_table_can_fail_and_are_ours(ddscbf, holds):
    found = cubic.claims(cubic_levels(ddscbf))
    assert [claim.holds for claim in found] == [bool(each) for each in holds]
    assert not any(claim.printed for claim in found)


def test_the_side_of_the_unfiltered_rate_is_computed():
    low, high = cubic.compare_with_no_filter({0.1: {"none": made(700)}, 0.15: {"none": made(500)}})
    assert "77.3 % of the CBF is above [67.1, 72.8]" in low
    assert "57.5 % of the CBF is above" in high
    low, high = cubic.compare_with_no_filter({0.1: {"none": made(770)}, 0.15: {"none": made(650)}})
    assert "is within [74.3, 79.5]" in low
    assert "is below [62.0, 67.9]" in high


def path(*safe):
    states = np.zeros((2, len(safe), 2))
    return cubic_paths.PlaneTrajectories(
        made(5), states, np.array([[0.1] * len(safe), [0.1 if each else -0.1 for each in safe]])
    )


def test_the_shown_episode_ends_as_in_the_text():
    found = {
        "a": path(0, 0, 0, 1),
        "b": path(1, 1, 0, 1),
        "c": path(1, 0, 0, 0),
        "d": path(1, 1, 1, 1),
    }
    assert cubic_paths.alike(found).tolist() == [1]
    assert cubic_paths.alike({**found, "d": path(1, 0, 1, 1)}).tolist() == []


def test_trajectories_towards_the_origin():
    states = np.stack([np.full((3, 2), 1.0), np.full((3, 2), 0.9), np.full((3, 2), 0.8)])
    assert cubic_paths.towards_origin(states).holds
    away = states.copy()
    away[2, 1] = 1.1
    assert not cubic_paths.towards_origin(away).holds
    # One that has ended is looked at where it was last.
    ended = states.copy()
    ended[1:, 2] = [[1.2, 1.2], [np.nan, np.nan]]
    found = cubic_paths.towards_origin(ended)
    assert not found.holds
    assert "2 of 3 trajectories come nearer" in found.evidence


def test_claims_about_pictures_can_fail():
    assert cubic_paths.all_safe(made(1000)).holds
    assert not cubic_paths.all_safe(made(999)).holds
    assert cubic_paths.lost(made(1000), made(770)).holds
    assert not cubic_paths.lost(made(1000), made(1000)).holds
    assert not cubic_paths.lost(made(770), made(1000)).holds
    assert cubic_paths.recovered(made(860), made(770)).holds
    assert not cubic_paths.recovered(made(770), made(860)).holds
    # Some are safe with DDSCBF only, as many with the CBF only.
    assert not cubic_paths.recovered(made(np.arange(1000) > 99), made(900)).holds
