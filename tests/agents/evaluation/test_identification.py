"""Evaluations of filters that rest on something learned: once or several times, from files or from
memory."""

from __future__ import annotations

import math

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate, make_problem
from safe_envs.agents.evaluation.identification import pooled
from safe_envs.agents.evaluation.rows import EpisodeSummary
from safe_envs.agents.evaluation.statistics import Curve
from safe_envs.filters.learning import LearnedFileError, learner_of

pytestmark = pytest.mark.slow

DISK = make_problem("CubicSDEDisk-v0", start=[-0.1, 0.7], horizon=0.2)
LINE = make_problem("Scalar-v0", start=[0.5], noise=0.5, horizon=0.5)
LEARNED = ("bayesian-scbf", "bayesian-scbf:confidence=0.9")


@pytest.fixture(scope="module")
def posterior():
    """Identify by default, with the seed of the first repeat of an evaluation with seed 0."""
    return learner_of("bayesian")(DISK, seed=0)


@pytest.fixture(scope="module")
def repeated():
    """Three identifications."""
    return evaluate(LINE, filters=["none", "scbf", *LEARNED], episodes=40, repeats=3, bounds=False)


def test_what_is_learned_once_serves_all_filters_and_is_not_learned_if_given(posterior, tmp_path):
    posterior.save(tmp_path / "disk.npz")
    names = ["bayesian-scbf", "bayesian-scbf:simultaneous=0.9"]
    named = [f"{name}:file={tmp_path}/disk.npz" for name in names]
    given = {"episodes": 5, "bounds": False}
    memory, file, text, learned = (
        evaluate(DISK, filters=filters, learned=models, num_envs=n, **given)
        for filters, models, n in (
            (names, [posterior], 5),
            (names, [tmp_path / "disk.npz"], 2),
            (named, (), 3),
            (names, (), 5),
        )
    )
    for rows in zip(*(each.rows for each in (memory, file, text, learned)), strict=True):
        first, *others = (
            {k: v for k, v in row.as_dict().items() if k not in {"learning", "filter"}}
            for row in rows
        )
        assert all(other == first for other in others)
        assert {row.learning.sha256[0] for row in rows} == {posterior.sha256}
    assert [row.learning.files for row in file.rows] == [[str(tmp_path / "disk.npz")]] * 2
    assert [row.learning.files for row in memory.rows] == [[]] * 2
    assert len(learned.learned) == 1


@pytest.mark.parametrize(
    ("env_id", "name", "settings"),
    [
        ("ACCGap-v0", "ddscbf", {"points": 30, "repetitions": 40}),
        ("QuadrotorAltitude-v0", "learned-hocbf", {"states": 200, "epochs": 5, "hidden": (8, 4)}),
    ],
)
def test_the_answer_is_the_same_for_every_num_envs_and_from_a_file(
    env_id, name, settings, tmp_path
):
    problem = make_problem(env_id, horizon=0.2)
    model = learner_of(name)(problem, seed=1, **settings)
    model.save(tmp_path / "model.npz")
    rows = []
    for num_envs, given in ((1, model), (3, tmp_path / "model.npz")):
        how = {"num_envs": num_envs, "learned": [given], "bounds": False}
        rows += evaluate(problem, filters=[name], episodes=3, **how).rows
    one, other = ({k: v for k, v in row.as_dict().items() if k != "learning"} for row in rows)
    assert one == other


@pytest.mark.parametrize(
    ("problem", "filters", "models", "repeats", "error", "fragment"),
    [
        (DISK, LEARNED, 2, 1, ConfigurationError, "two learned models"),
        (make_problem("Pendulum-v0"), LEARNED, 1, 1, LearnedFileError, "Pendulum"),
        (DISK, ["scbf", "ddscbf"], 1, 1, ConfigurationError, "bayesian"),
        (DISK, LEARNED, 1, 2, ConfigurationError, "repeats = 2"),
        (DISK, ["scbf"], 0, 2, ConfigurationError, "repeats = 2"),
        (DISK, LEARNED, 0, 0, ConfigurationError, "repeats"),
        (DISK, LEARNED, 0, 1.5, ConfigurationError, "repeats"),
        (DISK, LEARNED, 0, True, ConfigurationError, "repeats"),
    ],
)
def test_what_does_not_fit_is_refused(
    posterior, problem, filters, models, repeats, error, fragment
):
    given = [posterior] * models
    with pytest.raises(error, match=fragment):
        evaluate(problem, filters=filters, learned=given, repeats=repeats, episodes=2)


def test_rows_of_repeats_are_sums_means_and_wider_intervals(repeated):
    given = {"episodes": 40, "bounds": False, "num_envs": 7}
    once = evaluate(LINE, filters=["none", "scbf", *LEARNED], **given)
    for row, single in zip(repeated.rows, once.rows, strict=True):
        if row.learning is None:
            assert row == single
            continue
        learning = row.learning
        assert (learning.repeats, len(learning.seeds), len(set(learning.sha256))) == (3, 3, 3)
        assert row.episodes == 120
        assert row.safe == round(40 * sum(learning.rates))
        assert row.safety_rate == pytest.approx(np.mean(learning.rates))
        assert learning.rates[0] == single.safety_rate
        assert row.ci_low <= row.safety_rate <= row.ci_high
        assert row.curve.rate[-1] == pytest.approx(row.safety_rate)
        assert row.curve.ci_low[-1] == pytest.approx(row.ci_low)
        # Three identifications on the same 40 episodes are not 120 independent ones.
        half = 1.96 * math.sqrt(row.safety_rate * (1 - row.safety_rate) / 120)
        assert row.ci_high - row.ci_low > 2 * half
    # The seeds of identifications are those of no other evaluation.
    (other,) = evaluate(LINE, filters=LEARNED[0], seed=1, repeats=3, **given).rows
    seeds = repeated.rows[2].learning.seeds
    assert len({*seeds, *other.learning.seeds}) == 6
    (again,) = evaluate(LINE, filters=LEARNED[0], repeats=3, **given).rows
    assert again == repeated.rows[2]


def test_comparisons_of_repeats_have_no_p_value(repeated):
    for c in repeated.comparisons:
        learned = any(name in LEARNED for name in (c.first, c.second))
        assert (c.mcnemar_p is None) == learned
        assert c.both + c.only_first + c.only_second + c.neither == (120 if learned else 40)
        assert c.ci_low <= c.difference <= c.ci_high


def summary(safe, episodes, **changes):
    rates = [1.0, safe / episodes]
    row = {
        "episodes": episodes,
        "safe": safe,
        "violations": episodes - safe,
        "touching": 1,
        "safety_rate": safe / episodes,
        "ci_low": 0.0,
        "ci_high": 1.0,
        "curve": Curve([0.0, 1.0], [episodes, safe], rates, rates, rates),
    }
    means = ("min_h_median", "min_h_p05", "intervention_rate", "infeasible_rate")
    means += ("effort_mean", "return_mean")
    return EpisodeSummary(**{**row, **dict.fromkeys(means, safe / episodes), **changes})


def test_several_are_summed_and_averaged():
    one = summary(3, 10, effort_mean=None, below_rounding=2, worst_below_rounding=1e-12)
    found = pooled([one, summary(5, 10, effort_mean=2.0)], 0.95)
    assert (found.below_rounding, found.worst_below_rounding) == (2, 1e-12)
    assert (found.episodes, found.safe, found.violations, found.touching) == (20, 8, 12, 2)
    assert found.safety_rate == found.return_mean == pytest.approx(0.4)
    assert found.effort_mean == 2.0
    assert found.curve.safe == [20, 8]
    assert (found.ci_low, found.ci_high) == (found.curve.ci_low[1], found.curve.ci_high[1])
    assert pooled([summary(3, 10, effort_mean=None)] * 2, 0.95).effort_mean is None
    assert pooled([one], 0.95) == one


def test_bounds_over_posteriors_stand_beside_the_rates():
    name, told = "bayesian-scbf:simultaneous=0.9", []
    given = {"filters": ["bayesian-scbf", name], "episodes": 20, "progress": told.append}
    plain, row = evaluate(DISK, **given).rows
    assert plain.posterior_bound is None
    assert "posterior" in plain.continuous_note
    bound = row.posterior_bound
    assert (bound.delta, bound.supremum) == (pytest.approx(0.1), pytest.approx(1.0, abs=1e-6))
    # (1 - delta)(h_0 - m T)/c, of h = 1 - x_1^2 - x_2^2 with c = 1.
    expected = 0.9 * (1 - 0.1**2 - 0.7**2 - bound.shortfall * DISK.horizon)
    assert bound.probability == pytest.approx(expected, abs=1e-6)
    assert row.ci_high >= bound.probability > 0
    # One of three parts is the learning.
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)
    assert any(0 < part <= 1 / 3 for part in told)


def test_what_does_not_fit_the_heading_is_remarked(tmp_path):
    model = learner_of("ddscbf")(make_problem("ACCGap-v0"), points=30, repetitions=40)
    model.save(tmp_path / "gap.npz")

    def remarks(learned, knowledge="model", **options):
        given = {"filters": ["ddscbf"], "episodes": 4, "bounds": False, "knowledge": knowledge}
        options = {"horizon": 0.2, **options}
        (row,) = evaluate("ACCGap-v0", options=options, learned=[learned], **given).rows
        return row.learning.remarks

    for learned in (model, tmp_path / "gap.npz"):
        noise, *known = remarks(learned, "plant", noise=0.3)
        assert "sigma_1" in noise
        assert "here 0.3" in noise
        assert len(known) == 1
        assert len(remarks(learned, noise=0.3)) == 1
        assert remarks(learned) == []
