"""The claims of chapter 4 on made-up data: each can hold, and each can fail."""

from __future__ import annotations

import math

import numpy as np
import pytest

from safe_envs.scripts.reproduce.chapter_4 import (
    cruise,
    dubins_noise,
    dubins_points,
    dubins_runs,
    effort_claims,
    martingale,
    reciprocal_inputs,
)
from safe_envs.scripts.reproduce.chapter_4.effort_claims import EffortRecord
from safe_envs.scripts.reproduce.framework.artefact import Claim, Number
from safe_envs.scripts.reproduce.framework.episodes import Violations

H = reciprocal_inputs.DISTANCES
X = 1.0 - H
LAWS = {"RCBF": H**3 - X, "SRCBF": H**3 - X - 0.25 / H}


def held(claims: list[Claim]) -> list[bool]:
    """Whether each holds."""
    assert all(isinstance(claim.holds, bool) for claim in claims)
    return [claim.holds for claim in claims]


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        (LAWS, [True, True, True]),
        ({**LAWS, "SRCBF": LAWS["SRCBF"] * 1.01}, [False, True, True]),
        ({**LAWS, "RCBF": 2 * H**3 - X}, [False, True, True]),
        ({"RCBF": LAWS["SRCBF"], "SRCBF": LAWS["RCBF"]}, [False, False, False]),
    ],
)
def test_inputs_at_the_edge(asked: dict[str, np.ndarray], expected: list[bool]) -> None:
    """A wrong gamma, a wrong sign or a change of the two is seen."""
    assert held(reciprocal_inputs.claims_on_inputs(asked)) == expected


def test_certainty_is_lost_only_if_the_intervals_are_apart() -> None:
    """The bounded rate has to be the lower one."""
    low, high = (
        Number.rate(f"SRCBF, {where}", safe, 1000)
        for where, safe in (("|u| <= 1.5", 800), ("unbounded", 990))
    )
    assert martingale.claim_on_limits(low, high).holds
    assert not martingale.claim_on_limits(high, low).holds
    assert not martingale.claim_on_limits(low, low).holds
    assert not martingale.claim_on_limits(low, high).printed


def test_bound_is_contradicted_by_any_start() -> None:
    """A rate above the bound, or below it by chance, does not contradict it; one start that does is
    enough."""
    above, by_chance, below = (Number.rate("", safe, 1000) for safe in (800, 740, 700))
    assert martingale.claim_on_bound([above, by_chance], [0.75, 0.75]).holds
    claim = martingale.claim_on_bound([above, below], [0.75, 0.75])
    assert not claim.holds
    assert "at 1 of 2 starts" in claim.evidence
    assert ">=" not in claim.evidence


def test_bound_is_not_attained_off_the_closed_form() -> None:
    """All starts have to agree, from both sides."""
    rate = Number.rate("", 750, 1000)
    assert martingale.claim_on_attaining([rate, rate], [0.75, 0.76]).holds
    assert not martingale.claim_on_attaining([rate, rate], [0.75, 0.80]).holds
    assert not martingale.claim_on_attaining([rate, rate], [0.70, 0.75]).holds


def first(count: int, of: int = 100) -> np.ndarray:
    """Return flags of which the first ones are set."""
    return np.arange(of) < count


@pytest.mark.parametrize(
    ("counts", "expected", "words"),
    [
        ((92, 80, 25, 70), [True, True, True], "SRCBF loses 67.0 points, SCBF loses 10.0 points"),
        ((40, 100, 20, 100), [False, True, True], "SRCBF loses 20.0 points, SCBF loses nothing"),
        ((92, 76, 90, 80), [True, False, True], "SRCBF loses 2.0 points, SCBF gains 4.0 points"),
        ((92, 80, 85, 40), [True, False, False], "SCBF loses 40.0 points"),
        ((80, 80, 70, 70), [False, False, False], "+0.0 [0.0, 0.0]"),
    ],
)
def test_table(counts: tuple[int, ...], expected: list[bool], words: str) -> None:
    """Ties do not count, and what is lost or gained is told."""
    claims = cruise.claims_of_table(dict(zip(cruise.PRINTED, map(first, counts), strict=True)))
    assert held(claims) == expected
    assert words in claims[2].evidence


def run_of(effort: np.ndarray, barrier: float | np.ndarray = 1.0) -> EffortRecord:
    """A run in which the filter always acts."""
    return EffortRecord(effort, effort, np.broadcast_to(barrier, effort.shape))


def test_effort_over_time() -> None:
    """Most of the time counts, not a few peaks; what is not simulated in both does not."""
    ones, peaks = np.ones((10, 3)), np.full((10, 3), 0.5)
    peaks[:2] = 1e9
    ended = ones.copy()
    ended[1:] = np.nan
    larger, smaller = (
        effort_claims.share_of_time(run_of(a), run_of(b)) for a, b in ((peaks, ones), (ones, peaks))
    )
    assert larger == pytest.approx([0.2] * 3)
    assert smaller == pytest.approx([0.8] * 3)
    assert effort_claims.share_of_time(run_of(peaks), run_of(ended)) == pytest.approx([1.0] * 3)
    assert effort_claims.share_of_time(run_of(ones), run_of(ones)) == pytest.approx([0.0] * 3)
    assert not effort_claims.claim_on_time(larger, smaller).holds
    assert effort_claims.claim_on_time(smaller, larger).holds
    assert not effort_claims.claim_on_time(larger, larger).holds
    total = {"SRCBF": run_of(peaks), "SCBF": run_of(ones)}
    assert effort_claims.claim_on_total(total).holds
    assert not effort_claims.claim_on_total({"SRCBF": total["SCBF"], "SCBF": total["SRCBF"]}).holds


def test_effort_at_the_edge() -> None:
    """A force that grows like 1/h has no bound, a constant one has."""
    grows, stays = 1.0 / effort_claims.DISTANCES, np.full_like(effort_claims.DISTANCES, 200.0)
    assert [effort_claims.claim_on_edge(force).holds for force in (grows, stays)] == [True, False]
    assert [effort_claims.claim_on_bounded(force).holds for force in (grows, stays)] == [
        False,
        True,
    ]
    assert effort_claims.claim_on_edge(grows).printed
    assert not effort_claims.claim_on_bounded(stays).printed


def test_peaks_and_growth_are_checks_of_ours() -> None:
    """Both may fail, and a filter that never acts needs no force."""
    low, high = np.array([1.0, 1.0, 9.0]), np.array([2.0, 2.0, 2.0])
    assert effort_claims.claim_on_peaks(high, low).holds
    assert not effort_claims.claim_on_peaks(low, high).holds
    barrier = np.array([[0.1], [2.0]])
    claims = [
        effort_claims.claim_on_growth(run_of(np.array(effort), barrier))
        for effort in ([[5.0], [1.0]], [[1.0], [5.0]])
    ]
    assert held(claims) == [True, False]
    never = effort_claims.claim_on_growth(run_of(np.full((2, 1), np.nan), barrier))
    assert not never.holds
    assert "never below" in never.evidence
    assert not any(claim.printed for claim in (*claims, effort_claims.claim_on_peaks(high, low)))


def test_median_peak_is_between_order_statistics() -> None:
    """For 50 episodes the 18th and the 33rd hold the median with 95 %."""
    number = effort_claims.median_peak("SRCBF", np.arange(50.0, 0.0, -1.0) ** 2)
    assert (number.low, number.ours, number.high) == (18.0, 25.5, 33.0)


def runs_of(scbf: int, one: int, half: int, of: int = 200) -> dict[str, Violations]:
    """Runs with so many safe episodes."""
    return {
        name: Violations(np.where(first(count, of), 1000, 1), 0.1)
        for name, count in zip(dubins_runs.FILTERS, (scbf, one, half), strict=True)
    }


@pytest.mark.parametrize(
    ("by_noise", "holds"),
    [
        ([(150, 100, 120), (150, 90, 110)], True),
        ([(200, 200, 200), (150, 90, 110)], True),
        ([(100, 150, 50), (150, 90, 110)], False),
        ([(150, 100, 120), (150, 90, 151)], False),
        ([(150, 150, 100), (150, 90, 110)], False),
        ([(200, 200, 200), (200, 200, 200)], False),
    ],
)
def test_noises(by_noise: list[tuple[int, int, int]], holds: bool) -> None:
    """At every level and for all rates of the SZCBF, apart from levels at which neither fails, and
    somewhere for certain."""
    claim = dubins_noise.claim_on_noises(
        {level: runs_of(*counts) for level, counts in zip((0.0, 0.2), by_noise, strict=True)}, 5.0
    )
    assert claim.holds is holds
    assert "at 0," in claim.evidence


def test_noises_tells_ahead_from_behind() -> None:
    """The counts of the evidence."""
    claim = dubins_noise.claim_on_noises(
        {0.0: runs_of(100, 150, 99), 0.2: runs_of(150, 90, 110)}, 5.0
    )
    assert (
        "ahead of SZCBF(1, 1) at 1 of 2 noise levels, behind at 1: in points -25.0 ["
        in claim.evidence
    )
    assert (
        "ahead of SZCBF(.5, .5) at 1 of 2 noise levels, behind at 0: in points +0.5 ["
        in claim.evidence
    )


@pytest.mark.parametrize(
    ("by_start", "holds"),
    [
        ([(150, 90, 90), (100, 110, 110)], True),
        ([(150, 90, 90), (20, 110, 20)], False),
        ([(150, 90, 90), (20, 10, 110)], False),
    ],
)
def test_points(by_start: list[tuple[int, int, int]], holds: bool) -> None:
    """All starts together, and both rates: one start far ahead is not enough."""
    assert (
        dubins_points.claim_on_points([runs_of(*counts) for counts in by_start], 5.0).holds is holds
    )


def test_horizon_counts() -> None:
    """An exit after the horizon is none: with control periods of .05 s instant 101 is past 5 s,
    instant 100 is not."""
    late, soon = Violations(np.full(50, 101), 0.0), Violations(np.full(50, 100), 0.0)
    claim = dubins_points.claim_on_points(
        [{"SCBF": late, "SZCBF(1, 1)": soon, "SZCBF(.5, .5)": soon}], 5.0
    )
    assert claim.holds
    assert not dubins_points.claim_on_points(
        [{"SCBF": late, "SZCBF(1, 1)": soon, "SZCBF(.5, .5)": soon}], 10.0
    ).holds


def test_turning_time() -> None:
    """The first instant from which on the first row stays ahead."""
    run, other = (
        Violations(np.array([2, 2, 300, 300]), 0.0),
        Violations(np.array([1, 50, 50, 300]), 0.0),
    )
    assert dubins_runs.turning_time(run, other) == pytest.approx(2.5)
    assert dubins_runs.turning_time(other, run) is None


def test_bounds_of_the_disk() -> None:
    """At (1, 0) with the heading to the centre, sigma = .2: h = 8, A h = 4 - .08, c = 9 and 12 -
    .08."""
    starts = np.array([[1.0, 0.0, math.pi], [1.0, 0.0, 0.0]])
    product, union = dubins_points.printed_and_union_bound(starts)
    assert product == pytest.approx([8 / 9 * 3.92 / 11.92, 0.0])
    assert union == pytest.approx([8 / 9 + 3.92 / 11.92 - 1, 0.0])


def test_product_is_contradicted_where_the_rate_is_below_it() -> None:
    """In per cent as the rate, and only at starts for which it is anything."""
    runs = [runs_of(count, 0, 0)["SCBF"] for count in (20, 190, 0)]
    note = dubins_points.bound_note(
        "here", runs, np.array([0.5, 0.9, 0.0]), np.array([0.1, 0.2, 0.0])
    )
    assert "holds at 2 of 3" in note
    assert "at most 90.0 % there, and contradicted at 1 by T = 10 s" in note
    assert "in 10.0 % of the steps" in note


def test_alternative_settings_that_hold_are_named() -> None:
    """Both kinds of settings, or that there is none."""
    worse, better = ({0.0: runs_of(*counts)} for counts in ((100, 150, 150), (150, 100, 100)))
    found = dubins_runs.alternatives_of({"all starts": worse}, better, dubins_noise.claim_on_noises)
    assert list(found) == [
        *(f"{dubins_runs.BY_PRINTED_FORM}, T = {t} s" for t in (5, 3, 10)),
        "all starts, T = 3 s",
        "all starts, T = 10 s",
    ]
    note = dubins_runs.holds_note(found)
    assert note.index(dubins_runs.BY_PRINTED_FORM) < note.index(
        "It does not with: all starts, T = 3 s"
    )
    assert "none of the other settings" in dubins_runs.holds_note(
        {"all starts, T = 3 s": found["all starts, T = 3 s"]}
    )
