"""Studies: independent seeds, common episodes, and nothing done twice or otherwise after a stop;
files that describe them; interquartile means and bootstrap intervals over seeds."""

from __future__ import annotations

import itertools
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.stats import trim_mean

from safe_envs import ConfigurationError
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.jobs.executor import Backend
from safe_envs.agents.training import study as study_module
from safe_envs.agents.training.study import (
    Study,
    StudyResult,
    StudyRow,
    Variant,
    caution,
    differences,
    evaluation_seed,
    interquartile_mean,
    over_seeds,
    read_study,
    run_study,
    shipped_studies,
    summaries,
    training_seed,
)
from safe_envs.agents.training.trainer import train
from safe_envs.files import locked

SCALAR = "safe_envs/Scalar-v0"
SMALL = {
    "n_timesteps": 128,
    "num_envs": 4,
    "eval_freq": 64,
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
    return Study((SCALAR,), **{"variants": VARIANTS, **given, **changes})


def timeless(rows):
    return [replace(row, seconds=None) for row in rows]


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


def test_a_result_is_of_the_file_that_its_policy_had(tmp_path):
    place = tmp_path / "mine.py"
    few = replace(study(seeds=1), variants=(Variant("a", policy=f"{place}:law"),))
    found = []
    for law in ("0 * x", "0 * x", "1 + 0 * x"):
        place.write_text(f"def law(x):\n    return {law}")
        found.append(run_study(few, tmp_path / "out", ALONE).rows)
    assert found[0] == found[1]
    assert len(list((tmp_path / "out" / "results").iterdir())) == 2


@pytest.mark.slow
def test_an_agent_that_learned_behind_another_file_is_another_agent(tmp_path):
    place = tmp_path / "mine.py"
    own = {**SMALL, "n_timesteps": 64, "eval_freq": 64, "filter": f"{place}:Law"}
    few = replace(study(seeds=1, training=own), variants=(Variant("a", "ppo"),))
    for gain in (1, 2):
        place.write_text(f"from safe_envs.wrappers import CBF\nclass Law(CBF):\n    gain = {gain}")
        assert run_study(few, tmp_path / "out", ALONE).missing == {}
    assert len(list((tmp_path / "out" / "agents" / "Scalar-v0").iterdir())) == 2


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
    few = replace(study(seeds=1), variants=VARIANTS[1:])
    whole = run_study(few, tmp_path / "whole", ALONE)
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
        run_study(few, tmp_path / "part", ALONE)
    assert len(calls) == 2
    assert [path.name for path in calls[1].glob("checkpoint_*")] == [f"checkpoint_{64:012d}"]
    monkeypatch.setattr("safe_envs.agents.training.trainer.train", train)
    resumed = run_study(few, tmp_path / "part", ALONE)
    assert timeless(resumed.rows) == timeless(whole.rows)


@pytest.mark.oracle
def test_trainings_in_processes_are_those_of_one_process(tmp_path):
    # Every process imports torch, which takes longer than the trainings.
    few = replace(study(), variants=VARIANTS[:3])
    alone = run_study(few, tmp_path / "one", ALONE)
    together = run_study(few, tmp_path / "two", Backend(jobs=2))
    assert timeless(alone.rows) == timeless(together.rows)
    assert len(alone.rows) == 6


@pytest.mark.slow
def test_what_does_not_suit_an_env_is_told_and_the_rest_is_computed(tmp_path):
    variants = (Variant("nominal"), Variant("backup", filter="backup"))
    found = run_study(study(episodes=2, variants=variants), tmp_path, ALONE)
    assert [row.variant for row in found.rows] == ["nominal", "nominal"]
    ((key, reason),) = found.missing.items()
    assert key == (SCALAR, "backup", None)
    assert "BackupLaw" in reason


@pytest.mark.slow
def test_a_damaged_result_is_an_error_that_names_the_file(tmp_path):
    few = replace(study(), variants=VARIANTS[:1])
    run_study(few, tmp_path, ALONE)
    path = next((tmp_path / "results").iterdir())
    path.write_text(path.read_text().replace('"safe": ', '"safe": 1'))
    with pytest.raises(ConfigurationError, match="checksum"):
        run_study(few, tmp_path, ALONE)
    # Under the right checksum, but of another type.
    document = json.loads(path.read_text())
    document["row"]["safe"] = "all"
    store = study_module.ResultStore(path.parent)
    store.keep(path.stem, document["configuration"], {"row": document["row"]})
    with pytest.raises(ConfigurationError, match="safe is 'all'"):
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

    monkeypatch.setattr(study_module, "evaluate", found)
    few = replace(study(seeds=1), variants=(Variant("a", policy="zero"), Variant("b")))
    result = run_study(few, tmp_path, ALONE)
    assert [row.variant for row in result.rows] == ["b"]
    assert "mean return of the evaluation is nan" in result.missing[SCALAR, "a", 0]


def test_wrong_numbers_and_equal_names_are_errors():
    for call, fragment in (
        (lambda: study(seeds=0), "seeds = 0"),
        (lambda: replace(study(), variants=(Variant("a"), Variant("a", "ppo"))), "one name"),
        (lambda: Study(("Scaler-v0",), VARIANTS), "Scaler-v0"),
    ):
        with pytest.raises(ConfigurationError, match=fragment):
            call()


ONE = {"name": "one", "algorithm": "ppo", "filters": ["default", "none"]}
TWO = {"name": "two", "algorithm": "sac", "training": {"filter": "default", "action": "both"}}

BOMB = "a0: &a0 [1, 1]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 30)
)

MERGES = "a0: &a0 {name: a}\n" + "".join(
    f"a{k}: &a{k}\n  <<: [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 30)
)


def written(path, *variants, **more):
    path.write_text(yaml.safe_dump({"variants": list(variants), **more}))
    return str(path)


def test_every_shipped_study_can_be_planned():
    assert "filters-in-training" in shipped_studies()
    for name in shipped_studies():
        found = read_study(name)
        study = Study([SCALAR], found.variants, seeds=1, episodes=found.episodes)
        assert len(study.variants) >= len(found.agents) > 1


def test_a_file_of_ones_own(tmp_path):
    found = read_study(written(tmp_path / "s.yml", ONE, TWO, {"name": "nominal"}, episodes=7))
    assert found.episodes == 7
    assert [agent.name for agent in found.agents] == ["one", "two", "nominal"]
    one, alone, two, nominal = found.variants
    assert (one.algorithm, one.filter, alone.filter) == ("ppo", "default", "none")
    assert dict(two.training) == TWO["training"]
    assert two.filter == "none"
    assert (nominal.algorithm, nominal.policy) == (None, "nominal")
    quick = found.shortened({"n_timesteps": 10})
    assert dict(quick[2].training) == {**TWO["training"], "n_timesteps": 10}
    assert dict(quick[3].training) == {}
    with pytest.raises(ConfigurationError, match="one"):
        found.require_agent("ones")


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"name": 3}, "name = 3"),
        ({"name": "two\nlines"}, "printable"),
        ({"name": "red \x1b[31m"}, "printable"),
        ({"name": "a" * 81}, "printable"),
        ({"algorithm": None, "policy": "law.py:law"}, "runs none"),
        ({"algorithm": None, "policy": "os:abort"}, "runs none"),
        ({"filters": ["law.py:Condition"]}, "runs none"),
        ({"filters": ["cbf+os:abort"]}, "runs none"),
        ({"training": {"filter": "./a+b/law.py:Condition"}}, "runs none"),
        ({"training": {"filter": ["scbf"]}}, "filter"),
        ({"training": {"settings": [1]}}, "settings"),
        ({"algorithm": "pop"}, "ppo"),
        ({"algorithm": None, "training": {"filter": "scbf"}}, "no algorithm"),
        ({"policy": ["a"]}, "policy"),
        ({"training": {"fliter": "scbf"}}, "filter"),
        ({"training": {"seed": 1}}, "seed"),
        ({"training": {"knowledge": "plant"}}, "knowledge"),
        ({"filters": "scbf"}, "filters"),
        ({"penalty": 1.0}, "penalty"),
    ],
)
def test_what_is_wrong_in_a_file_is_told(tmp_path, changes, word):
    given = written(tmp_path / "s.yml", {**ONE, **changes})
    with pytest.raises(ConfigurationError, match=word):
        read_study(given)


def test_files_that_are_no_studies(tmp_path):
    for text, word in (
        ("variants: [", "YAML"),
        ("- 1", "names with values"),
        ("variants: 3", "list of variants"),
        ("variants: []\nepisodes: 0", "list of variants"),
        ("episodes: 0\nvariants: [{name: a}]", "episodes"),
        ("variants: [{name: a}, {name: a}]", "one name"),
        ("runs: 3", "runs"),
        (BOMB, "values"),
        (MERGES, "values"),
        (f"{MERGES}? {{<<: *a29}}\n: 1", "values"),
        (f"variants: &a [{'1, ' * 9000}*a]", "values"),
        ("variants: [{name: a}]\nvariants: [{name: b}]", "'variants' twice"),
        ("episodes: 2026-13-45", "YAML"),
        (f"episodes: {'9' * 5000}", "YAML"),
        (f"episodes: {'1:' * 300}1.0", "YAML"),
        ("episodes: !!int many", "YAML"),
        ("episodes: !!timestamp now", "YAML"),
        ("!!python/object/apply:os.getcwd []", "YAML"),
    ):
        (tmp_path / "s.yml").write_text(text)
        with pytest.raises(ConfigurationError, match=word):
            read_study(str(tmp_path / "s.yml"))
    with pytest.raises(ConfigurationError, match="filters-in-training"):
        read_study("filters-in-trainings")


def row_of(variant, k, filter_text, **values):
    given = {"safety_rate": 0.5, "return_mean": 1.0, "intervention_rate": None, "violations": None}
    return StudyRow(
        env_id=SCALAR,
        variant=variant,
        k=k,
        policy="p",
        filter=filter_text,
        in_loop="none",
        training_seed=None,
        evaluation_seed=k,
        episodes=10,
        safe=5,
        ci_low=0.0,
        ci_high=1.0,
        infeasible_rate=None,
        seconds=2.0,
        **{**given, **values},
    )


def test_statistics_of_agents_and_of_their_differences(tmp_path):
    read = read_study(written(tmp_path / "s.yml", ONE, {**ONE, "name": "two"}))
    returns = {"one": [1.0, 2.0, 4.0, 8.0, 16.0], "two": [3.0, 3.0, 3.0, 9.0, 18.0]}
    rows = []
    for name, values in returns.items():
        for k, value in enumerate(values):
            rows.append(row_of(f"{name} | default", k, "scbf", return_mean=value, violations=k))
            rows.append(
                row_of(f"{name} | none", k, "none", return_mean=-value, safety_rate=0.1 * k)
            )
    study = Study([SCALAR], read.variants)
    found = StudyResult(study, rows, {})
    one, two = summaries(found, read.agents, SCALAR)
    assert (one.name, one.filter) == ("one", "scbf")
    assert one.estimates["returns"] == over_seeds([returns["one"]])
    assert one.estimates["returns_alone"] == over_seeds([[-v for v in returns["one"]]])
    assert one.estimates["safety_alone"].value == pytest.approx(0.2)
    assert one.estimates["violations"].value == 2.0
    assert one.estimates["interventions"] is None
    assert two.estimates["seconds"].value == 2.0
    (less,) = differences(found, read.agents, SCALAR, "one")
    assert less.name == "two"
    paired = np.subtract(returns["two"], returns["one"])  # 2, 1, -1, 1, 2
    assert less.estimates["returns"] == over_seeds([paired.tolist()])
    assert less.estimates["violations"].value == 0.0
    # A training that failed has no partner.
    fewer = StudyResult(study, [r for r in rows if (r.variant, r.k) != ("two | default", 2)], {})
    (less,) = differences(fewer, read.agents, SCALAR, "one")
    assert less.estimates["returns"].seeds == 4
    assert summaries(StudyResult(study, [], {}), read.agents, SCALAR) == []


@pytest.mark.parametrize("count", range(1, 15))
def test_the_interquartile_mean_is_scipys_trimmed_mean(count):
    values = np.random.default_rng(count).normal(size=(6, count))
    expected = trim_mean(values, 0.25, axis=-1)
    np.testing.assert_allclose(interquartile_mean(values), expected, rtol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.95, 0.99])
def test_one_env_is_the_enumeration_of_all_draws(count, confidence):
    values = np.random.default_rng(count).normal(size=count)
    draws = np.array(list(itertools.product(values, repeat=count)))
    means = np.sort(trim_mean(draws, 0.25, axis=-1))
    # The smallest value up to which a share of at least `tail` of the draws lies, and its mirror
    # image.
    tail = (1 - confidence) / 2
    place = next(k for k in range(len(means)) if (k + 1) / len(means) >= tail - 1e-12)
    found = over_seeds([values], confidence)
    assert found.low == pytest.approx(means[place], abs=1e-14)
    assert found.high == pytest.approx(means[::-1][place], abs=1e-14)
    assert found.value == pytest.approx(trim_mean(values, 0.25))
    assert found.seeds == count


def test_several_envs_are_drawn_within_each():
    # Every draw from two constant envs is the same, whatever the envs.
    found = over_seeds([[1.0] * 5, [3.0] * 5])
    assert (found.value, found.low, found.high) == (2.0, 2.0, 2.0)
    # All draws of 3 of 3 in two envs, in comparison with those that are sampled.
    values = np.array([[0.1, 0.5, 0.8], [0.3, 0.35, 0.9]])
    of_env = [list(itertools.product(row, repeat=3)) for row in values]
    draws = np.array([a + b for a, b in itertools.product(*of_env)])
    means = np.sort(trim_mean(draws, 0.25, axis=-1))
    found = over_seeds(values.tolist(), 0.9)
    for end, tail in ((found.low, 0.05), (found.high, 0.95)):
        # Within three standard deviations of the number of draws below the end.
        error = 3 * np.sqrt(0.05 * 0.95 / 20_000)
        below, up_to = (means < end - 1e-12).mean(), (means <= end + 1e-12).mean()
        assert below - error <= tail <= up_to + error
    assert over_seeds(values.tolist(), 0.9) == found
    assert over_seeds(values.tolist(), 0.9, seed=1).value == found.value


def test_the_order_of_seeds_and_the_sign_do_not_matter():
    values = [0.2, 0.7, 0.1, 0.9, 0.4]
    found, mirrored = over_seeds([values]), over_seeds([[-v for v in values]])
    assert over_seeds([values[::-1]]) == found
    assert (mirrored.low, mirrored.high) == (-found.high, -found.low)
    assert found.low <= found.value <= found.high


def test_nothing_and_what_is_not_finite_are_errors():
    for strata in ([], [[]], [[1.0], []], [[1.0, float("nan")]], [[float("inf")]]):
        with pytest.raises(ConfigurationError, match="at least one number"):
            over_seeds(strata)
    with pytest.raises(ConfigurationError, match="confidence"):
        over_seeds([[1.0]], 1.0)


def coverage(draw, truth, count, trials, seed=0):
    """Return how often the 95 % interval of so many values holds the truth."""
    rng = np.random.default_rng(seed)
    found = [over_seeds([draw(rng, count)]) for _ in range(trials)]
    return np.mean([each.low <= truth <= each.high for each in found])


def normal(rng, count):
    return rng.normal(size=count)


def test_intervals_of_few_seeds_come_with_what_they_are_worth():
    assert "no length" in caution(1)
    assert over_seeds([[0.3]]).low == over_seeds([[0.3]]).high
    assert "over 3 seeds holds the true value in 75 %" in caution(3)
    assert caution(20) == ""


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("count", "rate"), [(2, 0.5), (3, 0.75), (4, 0.877), (5, 0.906), (8, 0.935)]
)
def test_how_often_the_interval_holds(count, rate):
    # The guide names the number for five seeds, and the notes of tables those up to five.
    assert count > 5 or f"in {round(100 * rate)} %" in caution(count)
    found = coverage(normal, 0.0, count, 20_000, seed=1)
    assert found == pytest.approx(rate, abs=4 * np.sqrt(rate * (1 - rate) / 20_000) + 5e-4)
