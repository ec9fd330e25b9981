"""Evaluations of filters that rest on something learned: once or several times, from files or from
memory."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate, make_problem
from safe_envs.agents.evaluation.identification import Learning, learned_of
from safe_envs.filters.learning import LearnedFileError, learner_of
from safe_envs.wrappers import BayesianSCBF

pytestmark = pytest.mark.slow

DISK = make_problem("CubicSDEDisk-v0", start=[-0.1, 0.7])
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


def test_what_several_filters_rest_on_is_learned_once():
    learning = Learning(DISK, ["none", *LEARNED, "bayesian-scbf+scbf"], (), 2, 5)
    assert learning.missing() == [("bayesian", 0), ("bayesian", 1)]
    learning.learn("bayesian", 0, None)
    assert learning.missing() == [("bayesian", 1)]
    first, second = (learning.conditions(name, 0)[0] for name in LEARNED)
    assert isinstance(first, BayesianSCBF)
    assert learned_of([first, second]) == [first.learned]
    assert learning.models() == [first.learned]


@pytest.mark.slow
def test_each_repeat_has_a_seed_of_its_own(posterior):
    learning = Learning(DISK, LEARNED, (), 4, 0)
    for repeat in range(4):
        learning.learn("bayesian", repeat, None)
    found = [learned_of(learning.conditions("bayesian-scbf", repeat))[0] for repeat in range(4)]
    assert found[0].sha256 == posterior.sha256
    seeds = [model.record.seed for model in found]
    assert seeds[0] == 0
    assert len(set(seeds)) == 4
    assert len({model.mean.tobytes() for model in found}) == 4
    # Evaluations with other seeds have other ones.
    assert not set(seeds) & {
        Learning(DISK, LEARNED, (), 4, seed)._child(repeat)
        for seed in range(1, 50)
        for repeat in range(4)
    }


def test_what_is_given_is_not_learned(posterior, tmp_path):
    posterior.save(tmp_path / "disk.npz")
    for given in (posterior, tmp_path / "disk.npz", str(tmp_path / "disk.npz")):
        learning = Learning(
            DISK, [*LEARNED, "scbf", "ddscbf", "ddscbf+bayesian-scbf"], [given], 5, 0
        )
        assert {method for method, _ in learning.missing()} == {"ddscbf"}
        assert learning.repeats("bayesian-scbf") == learning.repeats("scbf") == 1
        assert learning.repeats("ddscbf") == learning.repeats("ddscbf+bayesian-scbf") == 5
        assert learned_of(learning.conditions("bayesian-scbf", 3))[0].sha256 == posterior.sha256
    assert Learning(DISK, [f"bayesian-scbf:file={tmp_path}/disk.npz"], (), 1, 0).missing() == []


def test_what_does_not_fit_is_refused(posterior):
    with pytest.raises(ConfigurationError, match="two learned models of the method bayesian"):
        Learning(DISK, LEARNED, [posterior, posterior], 1, 0)
    with pytest.raises(LearnedFileError, match="Pendulum"):
        Learning(make_problem("Pendulum-v0"), LEARNED, [posterior], 1, 0)
    with pytest.raises(
        ConfigurationError, match="holds bayesian, which no filter uses; add bayesian-scbf"
    ):
        Learning(DISK, ["scbf", "ddscbf"], [posterior], 1, 0)
    for names, given in ((["scbf"], ()), (LEARNED, [posterior])):
        with pytest.raises(ConfigurationError, match="repeats = 2, but nothing is learned"):
            Learning(DISK, names, given, 2, 0)
    for repeats in (0, -1, 1.5, True):
        with pytest.raises(ConfigurationError, match="repeats"):
            Learning(DISK, LEARNED, (), repeats, 0)


@pytest.mark.slow
def test_the_filter_from_a_file_gives_the_same_as_from_memory(posterior, tmp_path):
    posterior.save(tmp_path / "disk.npz")
    names = ["bayesian-scbf", "bayesian-scbf:simultaneous=0.9"]
    memory, file, learned, named = (
        evaluate(DISK, filters=filters, episodes=10, learned=given, bounds=False)
        for filters, given in (
            (names, [posterior]),
            (names, [tmp_path / "disk.npz"]),
            (names, ()),
            ([f"{n}:file={tmp_path}/disk.npz" for n in names], ()),
        )
    )
    ignored = {"learning", "filter"}
    for rows in zip(*(each.rows for each in (memory, file, learned, named)), strict=True):
        first, *others = (
            {k: v for k, v in row.as_dict().items() if k not in ignored} for row in rows
        )
        assert all(other == first for other in others)
    assert [row.learning.files for row in file.rows] == [[str(tmp_path / "disk.npz")]] * 2
    assert [row.learning.files for row in memory.rows] == [[]] * 2
    assert file.rows[0].learning.sha256 == memory.rows[0].learning.sha256 == [posterior.sha256]


@pytest.mark.parametrize(
    ("env_id", "name", "settings"),
    [
        ("CubicSDE-v0", "ddscbf", {"points": 30, "repetitions": 40}),
        ("ACCGap-v0", "ddscbf", {"points": 30, "repetitions": 40}),
        ("QuadrotorAltitude-v0", "learned-hocbf", {"states": 200, "epochs": 5, "hidden": (8, 4)}),
        ("CubicSDEDisk-v0", "bayesian-scbf", {"starts": 100}),
        ("CubicSDEDisk-v0", "bayesian-scbf:confidence=0.9", {"starts": 100}),
        ("CubicSDEDisk-v0", "bayesian-scbf:simultaneous=0.9", {"starts": 100}),
    ],
)
def test_the_answer_is_the_same_for_every_num_envs_and_from_a_file(
    env_id, name, settings, tmp_path
):
    problem = make_problem(env_id, horizon=0.2)
    model = learner_of("bayesian" if name.startswith("bayesian") else name)(
        problem, seed=1, **settings
    )
    model.save(tmp_path / "model.npz")
    rows = [
        evaluate(
            problem, filters=[name], episodes=3, num_envs=num_envs, bounds=False, learned=[given]
        ).rows[0]
        for num_envs, given in ((1, model), (2, model), (3, tmp_path / "model.npz"))
    ]
    first, *others = ({k: v for k, v in row.as_dict().items() if k != "learning"} for row in rows)
    assert all(other == first for other in others)


@pytest.mark.slow
def test_rows_of_repeats_are_sums_means_and_wider_intervals(repeated):
    once = evaluate(LINE, filters=["none", "scbf", *LEARNED], episodes=40, bounds=False)
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


@pytest.mark.slow
def test_comparisons_of_repeats_have_no_p_value(repeated):
    for comparison in repeated.comparisons:
        learned = any(name in LEARNED for name in (comparison.first, comparison.second))
        assert (comparison.mcnemar_p is None) == learned
        c = comparison
        pairs = c.both + c.only_first + c.only_second + c.neither
        assert pairs == (120 if learned else 40)
        assert comparison.ci_low <= comparison.difference <= comparison.ci_high


@pytest.mark.slow
def test_it_is_repeatable(repeated):
    again = evaluate(LINE, filters=LEARNED[:1], episodes=40, repeats=3, num_envs=7, bounds=False)
    assert again.rows[0] in repeated.rows


@pytest.mark.slow
def test_bounds_over_posteriors_stand_beside_the_rates():
    name = "bayesian-scbf:simultaneous=0.9"
    found = evaluate(DISK, filters=["bayesian-scbf", name], episodes=30, repeats=2)
    plain, row = found.rows
    assert plain.posterior_bound is None
    assert "its bound over the posterior" in row.continuous_note
    assert row.posterior_bound.delta == pytest.approx(0.1)
    # (1 - delta)(h_0 - m T)/c, of h = 1 - x_1^2 - x_2^2 with c = 1, for the mean m of both
    # identifications.
    expected = 0.9 * (1 - 0.1**2 - 0.7**2 - row.posterior_bound.shortfall * DISK.horizon)
    assert row.posterior_bound.supremum == pytest.approx(1.0, abs=1e-6)
    assert row.posterior_bound.probability == pytest.approx(expected, abs=1e-6)
    assert row.ci_high >= row.posterior_bound.probability > 0


def test_progress_goes_from_the_learning_to_the_end():
    told = []
    evaluate(
        DISK,
        filters=["scbf", "bayesian-scbf"],
        episodes=8,
        num_envs=4,
        repeats=2,
        progress=told.append,
        bounds=False,
    )
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)
    assert sum(0 < part <= 2 / 5 for part in told) >= 2  # two of five parts are the learning


def test_what_does_not_fit_the_heading_is_remarked(tmp_path):
    model = learner_of("ddscbf")(make_problem("ACCGap-v0"), points=30, repetitions=40)
    model.save(tmp_path / "gap.npz")
    louder = {"noise": 0.3, "horizon": 0.5}
    for given in (model, tmp_path / "gap.npz"):
        for knowledge in ("model", "plant"):
            found = evaluate(
                "ACCGap-v0",
                filters=["ddscbf"],
                options=louder,
                episodes=4,
                learned=[given],
                knowledge=knowledge,
                bounds=False,
            )
            noise, *known = found.rows[0].learning.remarks
            assert re.fullmatch(
                r"it was learned from a plant with sigma_1 = .* \(here 0.3\), .*", noise
            )
            assert bool(known) == (knowledge == "plant")
    assert (
        evaluate(
            "ACCGap-v0",
            filters=["ddscbf"],
            options={"horizon": 0.5},
            episodes=4,
            learned=[model],
            bounds=False,
        )
        .rows[0]
        .learning.remarks
        == []
    )
