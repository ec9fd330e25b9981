"""Studies: independent seeds, common episodes, and nothing done twice or otherwise after a stop."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.jobs.executor import Backend
from safe_envs.agents.training import study as study_module
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.study import (
    Planned,
    Study,
    StudyResult,
    Variant,
    evaluation_seed,
    run_study,
    training_seed,
)
from safe_envs.agents.training.trainer import train
from safe_envs.files import locked

SCALAR = "safe_envs/Scalar-v0"
SMALL = {
    "n_timesteps": 256,
    "num_envs": 4,
    "eval_freq": 128,
    "eval_episodes": 4,
    "settings": {"n_steps": 16, "batch_size": 64},
}
VARIANTS = (
    Variant("nominal"),
    Variant("ppo", "ppo"),
    Variant("ppo + filter", "ppo", filter="default"),
    Variant("behind", "ppo", training={"filter": "default"}, filter="default"),
)
ALONE = Backend(jobs=1)


def study(**changes):
    given = {"seeds": 2, "episodes": 20, "training": SMALL, "options": {"horizon": 0.5}}
    return Study((SCALAR,), VARIANTS, **given | changes)


def test_seeds_of_trainings_and_evaluations_are_all_different_and_of_one_seed():
    ids = ("safe_envs/Scalar-v0", "safe_envs/ACC-v0")
    seeds = [f(s, e, k) for f in (training_seed, evaluation_seed) for s in (0, 1) for e in ids
             for k in range(50)]  # fmt: skip
    assert len(set(seeds)) == len(seeds)
    assert seeds[0] == training_seed(0, ids[0], 0)
    assert max(seeds) < 2**32
    # A study of more seeds begins with those of one of fewer.
    assert [training_seed(3, ids[0], k) for k in range(5)] == [
        training_seed(3, ids[0], k) for k in range(9)
    ][:5]
    # Streams of two trainings are uncorrelated, and episodes of two evaluations are not shared.
    first, second = (np.random.default_rng(training_seed(0, ids[0], k)) for k in (0, 1))
    correlation = np.corrcoef(first.normal(size=20_000), second.normal(size=20_000))[0, 1]
    assert abs(correlation) < 4 / np.sqrt(20_000)
    episodes = [
        {episode_seed(evaluation_seed(0, ids[0], k), i) for i in range(200)} for k in (0, 1)
    ]
    assert not episodes[0] & episodes[1]


def test_a_result_is_of_the_files_that_its_filter_and_its_policy_had(tmp_path):
    table, policy = tmp_path / "table.npz", tmp_path / "policy.zip"
    text = f"promise:p=0.9:table={table}"
    given = {"env_id": SCALAR, "variant": "a", "k": 0, "options": {}, "knowledge": "plant"}
    given |= {"episodes": 9, "seed": 0, "versions": {}}

    def found():
        training = Training.of(SCALAR, "ppo", filter=text)
        parts = ((None, policy, "none"), (None, "nominal", text), (training, "nominal", "none"))
        return [
            Planned(training=training, policy=str(policy), filter=text, **given)
            for training, policy, text in parts
        ]

    table.write_bytes(b"1")
    policy.write_bytes(b"1")
    first = found()
    assert [each.key for each in found()] == [each.key for each in first]
    agent = first[2].agent
    table.write_bytes(b"2")
    policy.write_bytes(b"2")
    second = found()
    assert not {each.key for each in first} & {each.key for each in second}
    # An agent that learned behind another table is another agent.
    assert second[2].agent != agent


@pytest.mark.slow
def test_an_agent_of_other_versions_is_neither_resumed_nor_taken_for_one_of_these(
    tmp_path, monkeypatch
):
    few = replace(study(seeds=1), variants=VARIANTS[1:2])
    run_study(few, tmp_path, ALONE)
    newer = {**study_module.package_versions(), "torch": "99"}
    monkeypatch.setattr(study_module, "package_versions", lambda: newer)
    found = run_study(few, tmp_path, ALONE)
    (reason,) = found.missing.values()
    assert "was trained with torch 2" in reason
    assert "in use is torch 99; remove that folder" in reason
    assert not found.rows


@pytest.mark.slow
def test_variants_share_agents_and_episodes_and_nothing_is_done_twice(tmp_path, monkeypatch):
    trained = []
    monkeypatch.setattr(
        "safe_envs.agents.training.trainer.train",
        lambda training, folder, **how: trained.append(folder) or train(training, folder, **how),
    )
    done = []
    found = run_study(study(), tmp_path, ALONE, done.append)
    assert not found.missing
    assert done[-1] == 1.0
    assert done == sorted(done)
    # Two agents each without and with the filter in the loop, and those of no variant twice.
    assert len(trained) == len(set(trained)) == 4
    assert [(r.variant, r.k) for r in found.rows] == [(v.name, k) for v in VARIANTS for k in (0, 1)]
    for k in (0, 1):
        of_seed = [row for row in found.rows if row.k == k]
        assert len({row.evaluation_seed for row in of_seed}) == 1
    assert len({row.evaluation_seed for row in found.rows}) == 2
    ppo, filtered = (found.of(SCALAR, name) for name in ("ppo", "ppo + filter"))
    assert [row.policy for row in ppo] == [row.policy for row in filtered]
    assert [row.filter for row in filtered] == ["scbf", "scbf"]
    assert (tmp_path / ppo[0].policy / "policy.npz").exists()
    assert ppo[0].return_mean != ppo[1].return_mean
    assert found.of(SCALAR, "nominal")[0].violations is None

    again = run_study(study(), tmp_path, ALONE)
    assert again.rows == found.rows
    assert len(trained) == 4
    # One more variant of an agent that is there is evaluated, and not trained.
    more = replace(study(), variants=(*VARIANTS, Variant("rcbf", "ppo", filter="cbf")))
    run_study(more, tmp_path, ALONE)
    assert len(trained) == 4
    # More seeds leave the first ones as they are.
    wider = run_study(study(seeds=3), tmp_path, ALONE)
    assert [row for row in wider.rows if row.k < 2] == list(found.rows)


@pytest.mark.slow
def test_an_interrupted_study_ends_as_an_uninterrupted_one(tmp_path, monkeypatch):
    whole = run_study(study(), tmp_path / "whole", ALONE)
    calls = []

    def stop(part):
        # After the checkpoint at half the steps.
        if part > 0.6:
            raise KeyboardInterrupt

    def stopped(training, folder, *, resume=False):
        calls.append(folder)
        return train(training, folder, resume=resume, progress=stop if len(calls) == 2 else None)

    monkeypatch.setattr("safe_envs.agents.training.trainer.train", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_study(study(), tmp_path / "part", ALONE)
    assert len(calls) == 2
    assert [path.name for path in calls[1].glob("checkpoint_*")] == [f"checkpoint_{128:012d}"]
    monkeypatch.setattr("safe_envs.agents.training.trainer.train", train)
    resumed = run_study(study(), tmp_path / "part", ALONE)
    assert [replace(row, seconds=None) for row in resumed.rows] == [
        replace(row, seconds=None) for row in whole.rows
    ]


def require_same_in_processes(variants, folder):
    """Check that two processes find what one finds."""
    few = replace(study(), variants=variants)
    alone = run_study(few, folder / "one", ALONE)
    together = run_study(few, folder / "two", Backend(jobs=2))
    assert [replace(row, seconds=None) for row in alone.rows] == [
        replace(row, seconds=None) for row in together.rows
    ]
    assert len(alone.rows) == 2 * len(variants)


@pytest.mark.slow
def test_processes_give_what_one_process_gives(tmp_path):
    require_same_in_processes(VARIANTS[:1], tmp_path)


@pytest.mark.oracle
def test_trainings_in_processes_are_those_of_one_process(tmp_path):
    # Every process imports torch, which takes longer than the trainings.
    require_same_in_processes(VARIANTS[:3], tmp_path)


@pytest.mark.slow
def test_what_does_not_suit_an_env_is_told_and_the_rest_is_computed(tmp_path):
    variants = (Variant("nominal"), Variant("promise", filter="promise:p=0.9"))
    ids = ("safe_envs/QuadrotorLimits-v0",)
    found = run_study(Study(ids, variants, 2, episodes=2), tmp_path, ALONE)
    assert [row.variant for row in found.rows] == ["nominal", "nominal"]
    ((key, reason),) = found.missing.items()
    assert key == (ids[0], "promise", None)
    assert "a grid takes at most 4" in reason


@pytest.mark.slow
def test_a_damaged_result_is_an_error_that_names_the_file(tmp_path):
    few = replace(study(), variants=VARIANTS[:1])
    run_study(few, tmp_path, ALONE)
    path = next((tmp_path / "results").iterdir())
    path.write_text(path.read_text().replace('"safe": ', '"safe": 1'))
    with pytest.raises(ConfigurationError, match="checksum"):
        run_study(few, tmp_path, ALONE)
    shutil.rmtree(tmp_path / "results")
    (tmp_path / "results").write_text("a file")
    with pytest.raises(ConfigurationError, match="cannot be made"):
        run_study(few, tmp_path, ALONE)


def test_two_studies_do_not_write_to_one_folder(tmp_path):
    few = replace(study(), variants=VARIANTS[:1])
    with (
        locked(tmp_path / ".lock", ""),
        pytest.raises(ConfigurationError, match="another study is writing"),
    ):
        run_study(few, tmp_path, ALONE)
    assert len(run_study(few, tmp_path, ALONE).rows) == 2
    assert not (tmp_path / ".lock").exists()


def test_a_failed_training_is_an_error_and_what_an_env_has_not_is_none():
    StudyResult(study(), [], {(SCALAR, "ppo", None): "no backup"}).require_all()
    with pytest.raises(
        ConfigurationError, match=r"1 evaluation failed.*ppo, training 1: it diverg"
    ):
        StudyResult(study(), [], {(SCALAR, "ppo", 1): "it diverged"}).require_all()


def test_a_return_that_is_no_number_stops_no_other_evaluation(tmp_path, monkeypatch):
    def found(_, policy, *args, **kwargs):
        result = evaluate("Scalar-v0", policy, *args, **kwargs)
        row = replace(result.rows[0], return_mean=float("nan"))
        return replace(result, rows=(row,)) if policy == "zero" else result

    monkeypatch.setattr(study, "evaluate", found)
    few = replace(study(seeds=1), variants=(Variant("a", policy="zero"), Variant("b")))
    result = run_study(few, tmp_path, ALONE)
    assert [row.variant for row in result.rows] == ["b"]
    assert "mean return of the evaluation is nan" in result.missing[SCALAR, "a", 0]


def test_wrong_numbers_and_equal_names_are_errors():
    with pytest.raises(ConfigurationError, match="seeds = 0"):
        study(seeds=0)
    with pytest.raises(ConfigurationError, match="one name"):
        replace(study(), variants=(Variant("a"), Variant("a", "ppo")))
    with pytest.raises(ConfigurationError, match="did you mean"):
        Study(("Scaler-v0",), VARIANTS)


def test_a_row_of_another_type_is_refused():
    with pytest.raises(TypeError, match="env_id is 1"):
        study.StudyRow(1, *[None] * 17)
