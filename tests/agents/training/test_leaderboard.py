"""The leaderboard: its variants, their statistics, and what is known of the best."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents.evaluation.attainable import AttainableSafety, best_for
from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.agents.training import leaderboard
from safe_envs.agents.training.leaderboard import (
    attainable_of,
    board,
    entry_of,
    require_no_older,
    safety_over_envs,
)
from safe_envs.agents.training.study import Study, StudyResult, StudyRow, Variant, over_seeds

SCALAR, PENDULUM = "safe_envs/Scalar-v0", "safe_envs/Pendulum-v0"


def row(env_id, variant, k, safe, trained=True):
    """Return the row of an agent with so many safe episodes of 50."""
    low, high = rate_interval(safe, 50)
    return StudyRow(
        env_id=env_id,
        variant=variant,
        k=k,
        policy="nominal",
        filter="none",
        in_loop="none",
        training_seed=k if trained else None,
        evaluation_seed=k,
        episodes=50,
        safe=safe,
        safety_rate=safe / 50,
        ci_low=low,
        ci_high=high,
        return_mean=10.0 * safe,
        intervention_rate=None,
        infeasible_rate=None,
        violations=100 * k if trained else None,
        seconds=60.0 * k if trained else None,
    )


def result(safe, seeds=5):
    """Return the result of a study from numbers of safe episodes by env and variant."""
    names = list(dict.fromkeys(variant for _, variant in safe))
    study = Study(
        tuple(dict.fromkeys(env_id for env_id, _ in safe)), [Variant(n) for n in names], seeds
    )
    rows = [
        row(env_id, variant, k, count, variant != "nominal")
        for (env_id, variant), counts in safe.items()
        for k, count in enumerate(counts)
    ]
    return StudyResult(study, rows, {})


def test_an_entry_has_the_statistics_over_seeds_and_over_episodes():
    safe = [50, 40, 45, 10, 44]
    found = entry_of(result({(SCALAR, "ppo"): safe}), SCALAR, "ppo")
    assert found is not None
    assert found.safety == over_seeds([[count / 50 for count in safe]])
    assert found.safety.value == pytest.approx((40 + 45 + 44) / 150)
    assert found.returns.value == pytest.approx(10 * (40 + 45 + 44) / 3)
    assert (found.safe, found.episodes) == (sum(safe), 250)
    assert (found.episodes_low, found.episodes_high) == rate_interval(sum(safe), 250)
    assert found.violations is not None
    assert found.violations.value == pytest.approx(200)
    assert found.minutes == pytest.approx(2.0)


def test_what_is_not_trained_has_no_cost_and_what_is_missing_no_entry():
    found = result({(SCALAR, "nominal"): [50] * 5})
    entry = entry_of(found, SCALAR, "nominal")
    assert entry is not None
    assert entry.violations is None
    assert entry.minutes is None
    assert entry_of(found, SCALAR, "ppo") is None


def test_over_envs_are_only_variants_that_all_envs_have():
    safe = {
        (SCALAR, "nominal"): [0, 1, 2, 3, 4],
        (SCALAR, "ppo"): [50] * 5,
        (PENDULUM, "nominal"): [5, 6, 7, 8, 9],
    }
    found = safety_over_envs(result(safe))
    assert list(found) == ["nominal"]
    assert found["nominal"].value == pytest.approx(np.mean([2, 3, 4, 5, 6, 7]) / 50)
    assert found["nominal"].seeds == 10


def test_all_variants_have_one_budget_and_promise_and_limit_ask_for_the_same():
    study = board([PENDULUM])
    names = [variant.name for variant in study.variants]
    assert names[:2] == ["nominal", "ppo"]
    assert {"ppo + filter", "ppo behind filter", "ppo + promise filter"} <= set(names)
    for variant in study.variants:
        assert not set(variant.training) & {"n_timesteps", "settings", "num_envs"}
    by_name = {variant.name: variant for variant in study.variants}
    limit = by_name["ppo-lag"].training["violation_limit"]
    assert by_name["ppo + promise filter"].filter == f"promise:p={1 - limit:g}"
    assert board([PENDULUM], quick=True).training["n_timesteps"] < 10_000
    # An algorithm without a constrained form has the other variants.
    assert [v.name for v in board([PENDULUM], algo="td3").variants][:3] == [
        "nominal",
        "td3",
        "td3 + filter",
    ]


def test_results_of_an_earlier_version_are_neither_read_nor_overwritten(tmp_path):
    require_no_older(tmp_path)
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "ACC-v0.json").write_text("{}")
    with pytest.raises(ConfigurationError, match="earlier version"):
        require_no_older(tmp_path)


def require_computed_and_kept(folder):
    """Check that what is known of the best is computed where it is asked for, and kept."""
    ids = (SCALAR, "safe_envs/QuadrotorLimits-v0")
    none = lambda _: None  # noqa: E731
    assert attainable_of(ids, folder, False, none) == {}
    found = attainable_of(ids, folder, True, none)
    best = found[SCALAR]
    assert not isinstance(best, str)
    assert best.lower is not None
    assert "at most 4" in str(found[ids[1]])
    again = attainable_of(ids[:1], folder, False, none)[SCALAR]
    assert not isinstance(again, str)
    assert (again.lower, again.upper) == (best.lower, best.upper)
    assert again.as_dict()["cells"] == list(best.cells)


def test_the_best_is_computed_where_it_is_asked_for_and_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("SAFE_ENVS_CACHE", str(tmp_path / "cache"))
    known = AttainableSafety(
        0.25, 0.5, None, "", "plant", "violation", "", ("x",), (40,), 41, 100, 1.0, 1000
    )
    monkeypatch.setattr(
        leaderboard,
        "best_for",
        lambda problem, *how: known if problem.name == "Scalar" else best_for(problem, *how),
    )
    require_computed_and_kept(tmp_path)
