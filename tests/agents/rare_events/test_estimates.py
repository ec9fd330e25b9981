"""Estimates of rare violations: the same in any batches and engines, doubted, or refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, NumericalError, define_problem
from safe_envs.agents import NominalController, ZeroController, make_problem
from safe_envs.agents.evaluation.statistics import log_normal_interval
from safe_envs.agents.policies.base import BlockPolicy
from safe_envs.agents.rare_events import splitting
from safe_envs.agents.rare_events.estimate import (
    PlainEpisodes,
    RareEstimate,
    doubt_of,
    estimate_rare,
    skewed_interval,
)
from safe_envs.agents.rare_events.numpy_paths import NumpyPaths, TiltedNoiseEnv
from safe_envs.agents.rare_events.splitting import ImportanceSampling, Splitting, optimal_tilt
from safe_envs.engine.program import Program
from safe_envs.errors import NotCompilableError
from safe_envs.problem.problem import Barrier
from tests.agents.rare_events.test_laws import SCALAR, row_of, two_channels
from tests.oracles.laws import X, brownian, mean_reverting

pytestmark = pytest.mark.slow

SHORT: dict[str, Any] = {"particles": 50, "repetitions": 10}
WALK = brownian(0.1, 1.0, 0.0, 0.3)
STEPS = make_problem("Scalar-v0", horizon=0.02)
TWO_WALLS = brownian(0.1, 1.0, 0.0, 0.3, [1 - X, 2 * (1 + X)])


class ByRow(BlockPolicy):
    """Acts by the row of its block alone, on which the rounding of a network depends."""

    def act(self, block):
        return np.linspace(-1.0, 1.0, len(block))[:, None]


@pytest.mark.parametrize(
    ("problem", "name", "arguments"),
    [
        (TWO_WALLS, "none", {"monitoring": "continuous"}),
        ("Scalar-v0", "szcbf", {"policy": "random", "options": SCALAR}),
        ("Scalar-v0", "szcbf", {"policy": ByRow(1), "options": SCALAR}),
    ],
    ids=["two barriers", "random policy", "network"],
)
def test_numbers_do_not_depend_on_the_envs_side_by_side(problem, name, arguments):
    wanted, other = (
        row_of(problem, name, engine="numpy", num_envs=n, **arguments, **SHORT) for n in (4096, 70)
    )
    assert wanted.levels > 0
    assert other == wanted


def test_same_seed_is_the_same_answer_and_is_json():
    first, second, other = (
        estimate_rare(WALK, filters=["none"], seed=s, **SHORT) for s in (1, 1, 2)
    )
    assert first.rows == second.rows
    assert first.rows != other.rows
    document = json.loads(json.dumps(first.document(), allow_nan=False))
    assert list(document) == ["config", "versions", "rows", "timing"]
    assert document["config"]["particles"] == 50


def assert_engines_agree(problem, name="none", **arguments):
    numpy, compiled = (
        row_of(problem, name, engine=engine, **arguments) for engine in ("numpy", "compiled")
    )
    for key in ("status", "reason", "method", "levels", "steps", "plain"):
        assert getattr(compiled, key) == getattr(numpy, key), key
    assert compiled.estimates == pytest.approx(numpy.estimates, rel=1e-9)
    return numpy


@pytest.mark.parametrize(
    ("problem", "name", "arguments"),
    [
        (brownian(0.1, 1.0, 0.0, 0.3), "none", {}),
        (TWO_WALLS, "none", {"monitoring": "continuous"}),
        (two_channels(), "none", {"policy": "random", "monitoring": "continuous"}),
        ("Scalar-v0", "szcbf", {"policy": "random", "options": {**SCALAR, "horizon": 0.5}}),
        ("StochasticDubins-v0", "scbf", {"options": {"horizon": 0.5, "noise": 0.6}}),
    ],
    ids=["walk", "two walls", "two channels", "scalar", "dubins"],
)
def test_programs_as_plain_python_play_the_paths_of_numpy(monkeypatch, problem, name, arguments):
    monkeypatch.setattr(Program, "compiled", Program.plain)
    # Records have to grow, and threads divide the paths.
    monkeypatch.setattr(splitting, "FIRST_ROOM", 2)
    monkeypatch.setattr("safe_envs.agents.rare_events.compiled_paths._FEWEST_PATHS", 2)
    row = assert_engines_agree(problem, name, particles=20, repetitions=10, **arguments)
    assert row.levels > 0


@pytest.mark.oracle
@pytest.mark.parametrize(
    "env_id", ["Scalar-v0", "StochasticDubins-v0", "CubicSDEDisk-v0", "Pendulum-v0"]
)
def test_estimates_of_both_engines_are_equal_but_for_rounding(env_id):
    given = {"particles": 100, "repetitions": 10, "monitoring": "continuous"}
    for name in ("none", "scbf"):
        assert_engines_agree(env_id, name, **given)


def test_pilots_and_estimates_have_noise_of_their_own():
    player = NumpyPaths(
        WALK, lambda lengths: TiltedNoiseEnv(WALK, lengths), ZeroController(WALK), 4096, False
    )
    keys, play = [], player.play

    def noting(paths, all_keys, *arguments):
        keys.append(all_keys[paths])
        return play(paths, all_keys, *arguments)

    player.play = noting
    Splitting(player, 0).pilot(50, 10)
    Splitting(player, 0).estimate(0.0, 50, 10)
    ImportanceSampling(player, 0).estimate(3.0, 50, 2)
    # Every generation of every path has noise of its own too.
    assert len(keys) > 10
    found = np.concatenate(keys)
    assert len(np.unique(found)) == len(found)


@pytest.mark.parametrize(
    ("problem", "power"),
    [(mean_reverting(1.0, 0.26), 0.0), (brownian(0.05, 2.0, -0.1, 0.15), 0.5)],
    ids=["mean reversion", "walk"],
)
def test_a_pilot_chooses_the_score_that_loses_less(problem, power):
    # The second score has the smaller spread in some pilots of the first law, and misses most of
    # its probability.
    tilted = lambda lengths: TiltedNoiseEnv(problem, lengths)  # noqa: E731
    player = NumpyPaths(problem, tilted, NominalController(problem), 4096, False)
    pilot = Splitting(player, 0).pilot(100, 20)
    assert (pilot.power, len(pilot.estimates), pilot.often) == (power, 20, False)
    assert pilot.enough() > 2 * pilot.particles


def test_scores_are_compared_by_how_high_unbiased_estimates_lie():
    high, low = np.exp([-1.0, 0.0, 1.0] * 7), np.exp([-2.1, -2.0, -1.9] * 7)
    better = splitting._better
    assert (better(high, low), better(low, high), better(high, high)) == (0, 1, 0)
    # One that is given up at times loses more than any other.
    lost = np.where(np.arange(21) == 3, 0.0, 100.0)
    assert (better(low, lost), better(lost, low), better(lost, lost)) == (0, 1, 0)


def test_the_best_drift_has_the_least_second_moment_and_other_ways_count_against_it():
    # Paths of noise W_1 = 5, by Girsanov: E[w; violation] = p exp(-5 c + c^2/2), least at c = 5.
    integrals, shares = np.tile([-5.0, 1.0], (50, 1)), np.full(50, 2e-8)
    length, deviation = optimal_tilt(integrals, shares, 1.0)
    assert length == pytest.approx(5.0, rel=1e-4)
    assert deviation == pytest.approx(math.sqrt(math.exp(-12.5) / 1e-6 - 1.0), rel=1e-6)
    integrals[0, 0] = 0.0
    assert optimal_tilt(integrals, shares, 1.0)[1] > 30 * deviation


def estimate(p, width, spread=0.1):
    estimates = p * np.exp(spread * np.resize((-1, 1), 20))
    return RareEstimate("splitting on h", p, p / width, p * width, 0.1, estimates.tolist())


NOTHING_SEEN = PlainEpisodes(5000, 0, 0.0, 7e-4)
FEW_SEEN = PlainEpisodes(5000, 5, 4e-4, 2e-3)


@pytest.mark.parametrize(
    ("found", "check", "plain", "doubt"),
    [
        (estimate(1e-7, 1.5), None, NOTHING_SEEN, None),
        (estimate(1e-7, 1.1), estimate(1.2e-7, 1.5), NOTHING_SEEN, None),
        (estimate(1e-7, 1.1), estimate(2e-7, 1.5), NOTHING_SEEN, "2e-07"),
        (estimate(1e-7, 1.5), None, FEW_SEEN, "5 violations among 5000"),
        (estimate(1e-7, 1.5, 0.38), None, NOTHING_SEEN, None),
        (estimate(1e-7, 1.5, 0.45), None, NOTHING_SEEN, "0.46"),
    ],
)
def test_what_contradicts_an_estimate(found, check, plain, doubt):
    told = doubt_of(found, check, plain)
    assert (told is None) if doubt is None else (doubt in told)


def test_an_interval_of_skewed_estimates_reaches_further_up():
    even = np.array([0.9, 1.0, 1.1] * 7)
    assert skewed_interval(even, 0.95) == log_normal_interval(even)
    skewed = np.array([1.0] * 19 + [3.0])
    (low, high), (coxs_low, coxs_high) = skewed_interval(skewed, 0.95), log_normal_interval(skewed)
    assert (low, high > coxs_high) == (coxs_low, True)
    assert skewed_interval(even, 0.95, 2.0)[1] > log_normal_interval(even)[1]
    assert skewed_interval(np.array([2.0, 2.0]), 0.95) == (2.0, 2.0)


@pytest.mark.parametrize("skew", [0.0, 1.0])
def test_an_interval_of_skewed_estimates_covers(skew):
    # Sums of log-normal numbers and of rarer, larger ones: of mean 1 and a deviation of .3.
    rng = np.random.default_rng(0)
    parts = np.exp(0.25 * rng.standard_normal((2000, 20)) - 0.25**2 / 2)
    rare = 1.0 * (rng.random(parts.shape) < 0.03)
    estimates = (parts + skew * rare) / (1.0 + 0.03 * skew)
    ends = [skewed_interval(each, 0.95) for each in estimates]
    assert np.mean([low < 1.0 < high for low, high in ends]) > 0.935


def jumping():
    step = Barrier(sp.Piecewise((1, X < 1), (-1, True)))
    return replace(WALK, barriers=(step,))


@pytest.mark.parametrize(
    ("problem", "name", "least", "fragment"),
    [
        (jumping(), "none", None, "stood at one level"),
        (brownian(0.05, 1.0, 0.0, 0.25), "none", 0.01, "10 of 10 repetitions"),
        ("DubinsDisk-v0", "hocbf", None, "nothing is random"),
    ],
)
def test_what_cannot_be_estimated_says_why(monkeypatch, problem, name, least, fragment):
    if least:
        monkeypatch.setattr(splitting, "LEAST", least)
    row = row_of(problem, name, **SHORT)
    assert row.status == "none"
    assert row.probability is row.ci_low is row.plain_episodes_needed is None
    assert fragment in row.reason


class Remembering(ZeroController):
    """A policy with a hidden state."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return super().predict(observation)[0], np.zeros(len(observation))


def custom(observations):
    return np.zeros((len(observations), 1))


@pytest.mark.parametrize(
    ("given", "error", "fragment"),
    [
        ({"policy": Remembering(WALK)}, ConfigurationError, "memory"),
        ({"particles": 19}, ConfigurationError, "particles = 19"),
        ({"particles": 2.5}, ConfigurationError, "particles = 2.5"),
        ({"repetitions": 9}, ConfigurationError, "repetitions = 9"),
        ({"num_envs": 0}, ConfigurationError, "num_envs = 0"),
        ({"problem": STEPS, "filters": ["promise:p=0.9"]}, ConfigurationError, "remembers"),
        ({"policy": custom, "engine": "compiled"}, NotCompilableError, "NumPy"),
    ],
)
def test_what_cannot_be_is_refused_and_named(given, error, fragment):
    with pytest.raises(error, match=fragment):
        estimate_rare(**{"problem": WALK, "filters": ["none"], **SHORT, **given})


def test_what_numba_cannot_compile_is_told_and_what_it_is_not_for_done_by_numpy(monkeypatch):
    def fail(*arguments):
        raise TypeError("no such operation")

    found = estimate_rare(WALK, custom, filters=["none"], engine="auto", **SHORT)
    assert found.timing["rows"][0]["engine"] == "numpy"
    entries = ("draw_path_starts", "play_paths")
    monkeypatch.setattr(Program, "compiled", lambda self: dict.fromkeys(entries, fail))
    with pytest.raises(NotCompilableError, match="no such operation"):
        row_of(WALK, engine="compiled")


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
def test_what_has_no_end_has_the_error_of_numpy(monkeypatch, engine):
    monkeypatch.setattr(Program, "compiled", Program.plain)
    u = sp.Symbol("u", real=True)
    system = ControlAffineSDE((X,), (u,), [X**3], [1], [0.01])
    given = {"input_bounds": (-1.0, 1.0), "start": [3.0], "dt": 0.1, "horizon": 2.0, "nominal": 1.0}
    with pytest.raises(NumericalError, match="finite"):
        row_of(define_problem(system, 1 + X**2, **given), engine=engine, **SHORT)
