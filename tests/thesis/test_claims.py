"""Claims on made-up outcomes: each can hold, and each can fail."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm, t

from safe_envs.agents import make_problem, rate_interval
from thesis.artefact import Number, Sample, texts
from thesis.chapter_3 import figure_3_1, figure_3_2, figure_3_3
from thesis.chapter_3.learning import Trajectory
from thesis.chapter_4 import dubins, example_4_2_2, figure_4_1, figure_4_2, figure_4_3, table_4_1
from thesis.chapter_5 import figure_5_1, figure_5_3, noise, table_5_1, table_5_2
from thesis.chapter_6 import bayes, figure_6_2, figure_6_3, table_6_1, table_6_2, table_6_3
from thesis.rates import MeasuredFilter, difference, safer
from thesis.verdict import Verdict, disagreement, judge

OBSTACLE = make_problem("DubinsObstacle-v0")
GOAL = (3.0, 1.5)


def holds(claims, word=""):
    """Whether the only claim with a word in it holds."""
    (claim,) = [claim for claim in claims if word in claim.sentence]
    return claim.holds


def first(count, of=1000):
    """Flags of which the first ones are set."""
    return np.arange(of) < count


def made(*safe):
    """1000 runs in which the first so many are safe, a number for each identification; or flags."""
    flags = [first(each) if isinstance(each, int) else each for each in safe]
    count, trials = int(np.sum(flags)), sum(map(len, flags))
    low, high = rate_interval(round(count / len(flags)), len(flags[0]))
    counts = {"safe": count, "episodes": trials, "violations": trials - count}
    row: Any = SimpleNamespace(**counts, safety_rate=count / trials, ci_low=low, ci_high=high)
    return MeasuredFilter(row, flags)


# --- chapter 3 ------------------------------------------------------------------------------------


@pytest.mark.parametrize("counts", [(1, 2, 2), (0, 0, 3), (2, 2, 2), (3, 3, 2), (3, 3, 3)])
def test_the_disk_is_safe_if_it_is_so_in_every_learning(counts):
    h = np.array([[0.1 if i < safe else -0.1 for i in range(3)] for safe in counts])
    number, claim = figure_3_1.numbers(h, 3)[0], figure_3_1.all_safe(h)
    assert number.ours == min(counts)
    assert (disagreement(number) is None) is claim.holds is (min(counts) == 3)
    assert f"{', '.join(map(str, counts))} of 3" in claim.evidence
    assert figure_3_1.theory_holds(h, np.full(3, -0.1)).holds is (min(counts) == 3)
    assert not figure_3_1.theory_holds(h, np.array([-0.1, -0.1, 0.1])).holds


def run_with(*h, at=(0.0, 0.0), lengths=()):
    """A run: its barrier, and its way along x from a point."""
    x = at[0] + np.concatenate([[0.0], np.cumsum(lengths or [0.0] * (len(h) - 1))])
    return Trajectory(np.stack([x, np.full(len(h), at[1])], axis=1), np.array(h, dtype=float))


def passage(learned=(1.0, 0.2), nominal=(1.0, -0.1), end=GOAL, lengths=None, unfiltered=0.02):
    """Ways past the obstacle that end where they are told to, at .8 m/s unless told otherwise."""
    lengths = lengths or [0.04] * (len(learned) - 1)
    way = run_with(*learned, at=(end[0] - sum(lengths), end[1]), lengths=lengths)
    none = run_with(1.0, -0.1, at=GOAL, lengths=[unfiltered])
    return {"learned": [way, way], "nominal": [run_with(*nominal, at=GOAL)], "none": [none]}


# A chord of an arc of .04 m that turns by pi/20 is no slowing down.
CHORD = 2 * 0.8 / math.pi * math.sin(math.pi * 0.05 / 2)


@pytest.mark.parametrize(
    ("claims", "word", "good", "bad"),
    [
        (figure_3_2.passage_claims, "avoids", {}, {"learned": (1.0, -0.01)}),
        (figure_3_2.passage_claims, "reaches", {}, {"end": (3.0, 1.81)}),
        (figure_3_2.passage_claims, "collides", {}, {"nominal": (1.0, 0.01)}),
        (figure_3_2.passage_claims, "longer", {}, {"lengths": [0.039]}),
        (figure_3_2.passage_claims, "longer", {}, {"unfiltered": 0.05}),
        (figure_3_2.clearance_claims, "always positive", {}, {"learned": (1.0, -0.01)}),
        (figure_3_2.clearance_claims, "falls below", {}, {"nominal": (1.0, 0.01)}),
        (figure_3_2.clearance_claims, "more time steps", {"learned": (1.0, 0.2, 0.2)}, {}),
        (figure_3_2.clearance_claims, "slows", {"lengths": [CHORD - 1e-6]}, {"lengths": [CHORD]}),
    ],
)
def test_claims_about_the_obstacle(claims, word, good, bad):
    fine, worse = passage(**good), passage(**bad)
    assert holds(claims(fine, OBSTACLE), word)
    assert not holds(claims(worse, OBSTACLE), word)
    # They hold only if they do in every learning.
    mixed = {**worse, "learned": [fine["learned"][0], worse["learned"][0]]}
    assert not holds(claims(mixed, OBSTACLE), word)


@pytest.mark.parametrize(
    ("nominal", "learned", "expected"),
    [(-0.1, 0.1, [True, True]), (0.1, 0.1, [False, True]), (-0.1, -0.1, [True, False])],
)
def test_claims_about_the_altitude(nominal, learned, expected):
    runs = {"nominal": [run_with(1.0, nominal)], "learned": [run_with(1.0, 0.1, learned)]}
    assert [claim.holds for claim in figure_3_3.altitude_claims(runs)] == expected


# --- chapter 4 ------------------------------------------------------------------------------------

H = example_4_2_2.DISTANCES
LAWS = {"RCBF": H**3 - (1 - H), "SRCBF": H**3 - (1 - H) - 0.25 / H}


@pytest.mark.parametrize(
    ("allowed", "expected"),
    [
        (LAWS, [True, True, True]),
        ({**LAWS, "SRCBF": LAWS["SRCBF"] * 1.01}, [False, True, True]),
        ({**LAWS, "RCBF": 2 * H**3 - (1 - H)}, [False, True, True]),
        ({"RCBF": LAWS["SRCBF"], "SRCBF": LAWS["RCBF"]}, [False, False, False]),
    ],
)
def test_claims_on_inputs_at_the_edge(allowed, expected):
    assert [claim.holds for claim in example_4_2_2.claims_on_inputs(allowed)] == expected


def test_claims_on_rates_of_reciprocal_conditions():
    low, high = Number.rate("SRCBF, |u| <= 1.5", 800, 1000), Number.rate("SRCBF, no", 990, 1000)
    limits = [(low, high), (high, low), (low, low)]
    assert [example_4_2_2.claim_on_limits(*each).holds for each in limits] == [True, False, False]
    # One start that contradicts the bound is enough; a rate below it by chance does not.
    above, by_chance, below = (Number.rate("", safe, 1000) for safe in (800, 740, 700))
    assert example_4_2_2.claim_on_bound([above, by_chance], [0.75, 0.75]).holds
    assert not example_4_2_2.claim_on_bound([above, below], [0.75, 0.75]).holds
    rates = [Number.rate("", 750, 1000)] * 2
    closed = [(0.75, 0.76), (0.75, 0.80), (0.70, 0.75)]
    attained = [example_4_2_2.claim_on_attaining(rates, each).holds for each in closed]
    assert attained == [True, False, False]


@pytest.mark.parametrize(
    ("counts", "expected", "words"),
    [
        ((92, 80, 25, 70), [True, True, True], "SRCBF 67.0 points, SCBF 10.0 points"),
        ((40, 100, 20, 100), [False, True, True], "SRCBF 20.0 points, SCBF 0.0 points"),
        ((92, 76, 90, 80), [True, False, True], "SRCBF 2.0 points, SCBF -4.0 points"),
        ((92, 80, 85, 40), [True, False, False], "SCBF 40.0 points"),
        ((80, 80, 70, 70), [False, False, False], "+0.0 points [0.0, 0.0]"),
    ],
)
def test_claims_of_table_4_1(counts, expected, words):
    cells = zip(table_4_1.PRINTED, counts, strict=True)
    claims = table_4_1.claims_of({name: first(count, 100) for name, count in cells})
    assert [claim.holds for claim in claims] == expected
    assert words in claims[2].evidence


def effort(values, barrier: Any = 1.0):
    """A run in which the filter always acts."""
    values = np.array(values, dtype=float)
    return figure_4_1.Effort(values, values, np.broadcast_to(barrier, values.shape))


def test_claims_on_effort():
    """Most of the time counts, not a few peaks; what is not simulated in both does not."""
    ones, peaks = np.ones((10, 3)), np.full((10, 3), 0.5)
    peaks[:2] = 1e9
    ended = ones.copy()
    ended[1:] = np.nan
    larger, smaller = figure_4_1.share_of_time(effort(peaks), effort(ones))
    assert (larger[0], smaller[0]) == (0.2, 0.8)
    assert figure_4_1.share_of_time(effort(peaks), effort(ended))[0] == pytest.approx([1.0] * 3)
    assert figure_4_1.share_of_time(effort(ones), effort(ones))[0] == pytest.approx([0.0] * 3)
    on_time = [(larger, smaller), (smaller, larger), (larger, larger)]
    assert [figure_4_1.claim_on_time(*each).holds for each in on_time] == [False, True, False]
    assert figure_4_1.claim_on_total(effort(peaks), effort(ones)).holds
    assert not figure_4_1.claim_on_total(effort(ones), effort(peaks)).holds
    grows, stays = 1.0 / figure_4_1.DISTANCES, np.full_like(figure_4_1.DISTANCES, 200.0)
    assert [figure_4_1.claim_on_edge(force).holds for force in (grows, stays)] == [True, False]
    assert [figure_4_1.claim_on_bounded(force).holds for force in (grows, stays)] == [False, True]
    low, high = np.array([1.0, 1.0, 9.0]), np.array([2.0, 2.0, 2.0])
    assert figure_4_1.claim_on_peaks(high, low).holds
    assert not figure_4_1.claim_on_peaks(low, high).holds
    barrier = [[0.1], [2.0]]
    for values, grown in (([[5.0], [1.0]], True), ([[1.0], [5.0]], False)):
        assert figure_4_1.claim_on_growth(effort(values, barrier)).holds is grown
    never = figure_4_1.claim_on_growth(effort(np.full((2, 1), np.nan), barrier))
    assert not never.holds
    assert "never below" in never.evidence
    # For 50 episodes the 18th and the 33rd hold the median with 95 %.
    number = figure_4_1.median_peak("SRCBF", np.arange(50.0, 0.0, -1.0) ** 2)
    assert (number.low, number.ours, number.high) == (18.0, 25.5, 33.0)


def runs_of(*counts):
    """200 runs of SCBF and both SZCBFs with so many safe ones."""
    return {
        name: dubins.Violations(np.where(first(count, 200), 1000, 1), 0.1)
        for name, count in zip(dubins.FILTERS, counts, strict=True)
    }


@pytest.mark.parametrize(
    ("calm", "noisy", "expected"),
    [
        ((150, 100, 120), (150, 90, 110), True),
        ((200, 200, 200), (150, 90, 110), True),  # where neither fails, none can be better
        ((100, 150, 50), (150, 90, 110), False),
        ((150, 100, 120), (150, 90, 151), False),
        ((150, 150, 100), (150, 90, 110), False),
        ((200, 200, 200), (200, 200, 200), False),
    ],
)
def test_claim_of_figure_4_2(calm, noisy, expected):
    claim = figure_4_2.claim_on_noises({0.0: runs_of(*calm), 0.2: runs_of(*noisy)}, 5.0)
    assert claim.holds is expected


def test_evidence_of_figure_4_2_tells_ahead_from_behind():
    claim = figure_4_2.claim_on_noises({0.0: runs_of(100, 150, 99), 0.2: runs_of(150, 90, 110)}, 5)
    assert "SZCBF(1, 1) at 1 of 2 noise levels, behind at 1: -25.0 points [" in claim.evidence
    assert "SZCBF(.5, .5) at 1 of 2 noise levels, behind at 0: +0.5 points [" in claim.evidence


@pytest.mark.parametrize(
    ("by_start", "expected"),
    [
        ([(150, 90, 90), (100, 110, 110)], True),
        ([(150, 90, 90), (20, 110, 20)], False),
        ([(150, 90, 90), (20, 10, 110)], False),
    ],
)
def test_claim_of_figure_4_3(by_start, expected):
    runs = [runs_of(*counts) for counts in by_start]
    assert figure_4_3.claim_on_points(runs, 5.0).holds is expected


def test_an_exit_after_the_horizon_is_none():
    # With control periods of .05 s instant 101 is past 5 s, instant 100 is not.
    late, soon = (dubins.Violations(np.full(50, k), 0.0) for k in (101, 100))
    runs = [{"SCBF": late, **dict.fromkeys(dubins.ALPHAS, soon)}]
    assert figure_4_3.claim_on_points(runs, 5.0).holds
    assert not figure_4_3.claim_on_points(runs, 10.0).holds
    others = dubins.alternatives_of({"all starts": runs}, runs, figure_4_3.claim_on_points)
    assert [name.rpartition("T = ")[2] for name in others] == ["5 s", "3 s", "10 s", "3 s", "10 s"]


# --- chapter 5 ------------------------------------------------------------------------------------


def test_claims_on_a_learned_term():
    truth = -(np.linspace(-1.0, 1.0, 21) ** 2)  # rms .49, about its mean .32
    assert figure_5_1.as_derived("", truth, truth).holds
    assert not figure_5_1.as_derived("", truth, 1.001 * truth).holds
    errors = {(0.1, 0.1, 0.1): True, (0.1, 0.3, 0.1): False, (0.4, 0.4, 0.4): False}
    assert {each: figure_5_1.learnable(each, truth).holds for each in errors} == errors
    assert figure_5_1.near([0.04, 0.05], truth).holds
    assert not figure_5_1.near([0.05, 0.05], truth).holds
    number, half = figure_5_1.root_mean_square("", np.sqrt([1.0, 3.0] * 50)), 1.96 * (1 / 99) ** 0.5
    expected = [math.sqrt(2.0), math.sqrt(2.0 - half), math.sqrt(2.0 + half)]
    assert [number.ours, number.low, number.high] == pytest.approx(expected)


def pendulum(scbf=920, ddscbf=910, cbf=0, quiet=1000):
    runs = {"scbf": scbf, "ddscbf": ddscbf, "cbf": cbf, noise.WITHOUT_RATE: 900}
    return table_5_1.outcome_of("cbf", {k: made(v) for k, v in runs.items()}, made(quiet))


@pytest.mark.parametrize(
    ("counts", "failed"),
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
def test_claims_of_table_5_1(counts, failed):
    sentences = [claim.sentence for claim in pendulum(**counts).claims if not claim.holds]
    assert len(sentences) == len(failed)
    assert all(map(str.startswith, sentences, failed))
    reproduced = judge(pendulum(), Sample()).verdict == Verdict.REPRODUCED
    assert reproduced  # by the printed numbers themselves


def test_closeness_needs_the_whole_interval_within_what_the_printed_samples_resolve():
    assert noise.resolution(50.0, 50.0) == pytest.approx(196 * math.sqrt(0.5 / 1000))
    rates = {(910, 910): True, (890, 910): False, (910, 890): False}  # 2 points, perhaps 2.4
    found = {
        pair: noise.close({"ddscbf": made(pair[0]), "scbf": made(pair[1])}, 92.0, 91.0).holds
        for pair in rates
    }
    assert found == rates


def test_differences_are_of_pairs_and_of_identifications():
    half = first(500)
    gap = difference("", made(600).flags, made(500).flags)
    assert gap.text == "+10.0 points [8.1, 11.9]"
    # As many one way as the other: the difference is none, though no episode ends alike.
    none = difference("", [half], [~half])
    assert (none.ours, none.is_above(), none.is_below(), none.is_above(-5.0)) == (0, 0, 0, 0)
    # Identifications may differ by more than their mean does from the other rate.
    assert difference("", made(500, 600, 700).flags, made(500).flags).ours == pytest.approx(10.0)
    pairs = [
        (made(600), True),
        (made(500, 600, 700), False),
        (made(400), False),
        (made(503), False),
    ]
    assert [safer("", found, made(500)).holds for found, _ in pairs] == [h for _, h in pairs]


@pytest.mark.parametrize(
    ("ddscbf", "expected"),
    [((850, 850), [1, 1, 1, 1]), ((770, 890), [0, 0, 0, 1]), ((850, 771), [1, 0, 1, 0])],
)
def test_claims_of_table_5_2(ddscbf, expected):
    levels = {
        k: {"scbf": made(850), "ddscbf": made(count), table_5_2.CBF: made(770)}
        for k, count in zip(table_5_2.LEVELS, ddscbf, strict=True)
    }
    claims = table_5_2.claims_of(levels)
    assert [claim.holds for claim in claims] == expected
    assert not any(claim.printed for claim in claims)


def test_claims_of_figure_5_3():
    def paths(runs, *safe):
        states = np.stack([np.full((3, 2), 1.0), np.full((3, 2), 0.9), np.full((3, 2), 0.8)])
        return figure_5_3.Paths(runs, states, np.array(safe, dtype=bool))

    found = {
        "a": paths(made(0), 0, 0, 0, 1),
        "b": paths(made(1000), 1, 1, 0, 1),
        "c": paths(made(770), 1, 0, 0, 0),
        "d": paths(made(860), 1, 1, 1, 1),
    }
    assert figure_5_3.alike(found).tolist() == [1]
    assert all(figure_5_3.claim_of(letter, found).holds for letter in found)
    worse = {
        "b": {**found, "b": paths(made(999))},
        "c": {**found, "c": paths(made(1000))},
        # Some are safe with DDSCBF only, as many with the CBF only.
        "d": {**found, "c": paths(made(900)), "d": paths(made(~first(100)))},
    }
    assert not any(figure_5_3.claim_of(letter, each).holds for letter, each in worse.items())
    away, ended = found["a"].states.copy(), found["a"].states.copy()
    away[2, 1] = 1.1
    assert not figure_5_3.towards_origin(away).holds
    ended[1:, 2] = [[1.2, 1.2], [np.nan, np.nan]]  # it is looked at where it was last
    assert "2 of 3 trajectories come nearer" in figure_5_3.towards_origin(ended).evidence


# --- chapter 6 ------------------------------------------------------------------------------------

DRAWS = norm.ppf((np.arange(10_000) + 0.5) / 10_000)
"""Of a standard normal posterior."""


def test_one_more_of_many_is_in_its_interval_with_95_percent():
    values = np.random.default_rng(0).standard_normal((4000, 5))
    new = np.random.default_rng(1).standard_normal(4000)
    ends = np.array([bayes.one_more(each) for each in values]).T
    assert np.mean((ends[0] <= new) & (new <= ends[1])) == pytest.approx(0.95, abs=0.012)
    found = bayes.predicted("a", np.exp([1.0, 2.0, 3.0]), 7.0, "s")
    half = t.ppf(0.975, 2) * math.sqrt(4 / 3)
    expected = (math.exp(2.0), math.exp(2.0 - half), math.exp(2.0 + half))
    assert (found.ours, found.low, found.high) == pytest.approx(expected)


def test_the_interval_of_a_rate_is_that_with_one_more_identification():
    low, high = rate_interval(700, 1000)
    same = bayes.rate_of_one_more("a", made(700, 700).flags, 65)
    assert same.ends == pytest.approx((100 * low, 100 * high))
    assert same.printed_trials == 1000
    found = bayes.rate_of_one_more("a", made(690, 700, 710).flags)
    half = t.ppf(0.975, 2) * 0.01 * math.sqrt(4 / 3)
    ends = 70 - 100 * math.hypot(0.7 - low, half), 70 + 100 * math.hypot(high - 0.7, half)
    assert found.ends == pytest.approx(ends)
    assert bayes.rate_of_one_more("a", made(100, 1000).flags).high == 100.0


@pytest.mark.parametrize(
    ("true", "expected"),
    [((0.0, 2.2), True), ((2.2, -2.2), True), ((0.0, 2.3), False), ((-2.3, 0.0), False)],
)
def test_posteriors_are_around_the_truth_together_in_95_percent(true, expected):
    # Each of the two with 97.5 %, that is 2.24 standard deviations.
    assert figure_6_2.gathered([DRAWS, DRAWS], true).holds is expected
    alone = figure_6_2.credible("sigma", DRAWS, "")
    assert alone.ends == pytest.approx((-1.96, 1.96), abs=1e-3)


def errors(*levels, width=0.05):
    """Errors of five identifications around a level for each K, independent of each other."""
    logs = width * np.random.default_rng(3).standard_normal((len(levels), 5))
    return {k: x * np.exp(each) for k, x, each in zip((10, 30, 100), levels, logs, strict=True)}


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (errors(1.0, 0.3, 0.1), True),
        (errors(1.0, 0.3, 0.3), False),
        (errors(0.3, 1.0, 0.1), False),
        (errors(1.0, 0.9, 0.8, width=2.0), False),
    ],
)
def test_an_error_falls_if_it_surely_does(found, expected):
    assert table_6_1.falls("f", found).holds is expected


@pytest.mark.parametrize(
    ("printed", "expected"),
    [((2.0, 0.6, 0.2), True), ((1.0, 0.3, 0.05), False), ((1.0, 0.1, 0.1), False)],
)
def test_a_printed_fall_is_possible_or_not(printed, expected):
    assert table_6_1.falls_as_printed("f", errors(1.0, 0.3, 0.1), printed).holds is expected


def test_similar_is_decided_by_the_interval_in_printed_points():
    def similar(*pairs):
        return bayes.similar({str(i): (made(*a), made(b)) for i, (a, b) in enumerate(pairs)}).holds

    near, far = ((890, 880), 900), ((700, 710), 900)
    assert [similar(near), similar(far), similar(near, far)] == [True, False, False]
    assert not similar(((500, 900), 750))  # in the mean, but not for certain
    # The limit is the largest printed difference.
    disk, car = (texts()[name].printed for name in ("table-6.2", "table-6.3"))
    pairs = [*zip(disk["SCBF"], disk["Bayesian SCBF"], strict=True)]
    pairs.append((car["SCBF"], car["Bayesian SCBF"]))
    assert max(abs(a - b) for a, b in pairs) == bayes.SETTINGS.similar


def test_measured_rates_are_above_the_worst_case_or_not():
    def claim(*safe):
        each = [Number.rate("", count, 1000) for count in safe]
        there = ([Number.rate("x", 910, 1000)], 50.0)
        return table_6_2.above_worst(1.0, {"here": (each, 35.0), "there": there}).holds

    # 36 % are not surely more than 35 %.
    assert [claim(550, 450, 430), claim(550, 450, 340), claim(360)] == [True, False, False]
    late = {safe: {"here": (Number.rate("a", safe, 250), 50.0)} for safe in (120, 105)}
    claims = {safe: table_6_2.worst_for_ever(400.0, each).holds for safe, each in late.items()}
    assert claims == {120: True, 105: False}


@pytest.mark.parametrize(
    ("second", "said"),
    [
        ((1000, 560, 300), "first at T = 0.50 s"),
        ((1000, 750, 700), "with 90.5 %, and has 75.0 % from the second one then"),
    ],
)
def test_both_printed_rates_are_looked_for_at_one_horizon(second, said):
    def measured(safe):
        curve = SimpleNamespace(time=[0.0, 0.5, 1.0], safe=list(safe))
        row: Any = SimpleNamespace(episodes=1000, curve=curve)
        return MeasuredFilter(row, [])

    assert said in table_6_2.at_one_horizon(measured((1000, 905, 850)), measured(second), (91, 55))


def test_claims_on_the_drift_of_the_car_and_on_times():
    assert figure_6_3.validated(Number("a", 0.9, 0.8, 1.1)).holds
    assert not figure_6_3.validated(Number("a", 1.2, 1.05, 1.35)).holds
    assert figure_6_3.near("f", np.array([0.01, 0.011, 0.012])).holds
    assert not figure_6_3.near("f", np.array([0.05, 0.08, 0.1])).holds
    expected = {0.5: [False, False], 5.0: [True, False], 12.0: [True, True]}
    found = {ratio: [c.holds for c in table_6_3.sooner(ratio)] for ratio in expected}
    assert found == expected
