"""Studies that files describe, and their statistics agent by agent."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from safe_envs import ConfigurationError
from safe_envs.agents.training.study import (
    Study,
    StudyResult,
    StudyRow,
    differences,
    over_seeds,
    read_study,
    shipped_studies,
    summaries,
)

SCALAR = "safe_envs/Scalar-v0"
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
        ({"name": "a | b"}, "printable"),
        ({"name": "a" * 81}, "printable"),
        ({"algorithm": None, "policy": "law.py:law"}, "runs none"),
        ({"algorithm": None, "policy": "os:abort"}, "runs none"),
        ({"filters": ["law.py:Condition"]}, "runs none"),
        ({"filters": ["cbf+os:abort"]}, "runs none"),
        ({"training": {"filter": "./a+b/law.py:Condition"}}, "runs none"),
        ({"training": {"filter": ["scbf"]}}, "filter"),
        ({"training": {"settings": [1]}}, "settings"),
        ({"training": {"settings": "gamma"}}, "settings"),
        ({"algorithm": "pop"}, "ppo"),
        ({"algorithm": None, "training": {"filter": "scbf"}}, "no algorithm"),
        ({"policy": ["a"]}, "policy"),
        ({"training": {"fliter": "scbf"}}, "filter"),
        ({"training": {"seed": 1}}, "seed"),
        ({"training": {"knowledge": "plant"}}, "knowledge"),
        ({"training": [1]}, "training"),
        ({"filters": "scbf"}, "filters"),
        ({"filters": []}, "filters"),
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


def row(variant, k, filter_text, **values):
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
            rows.append(row(f"{name} | default", k, "scbf", return_mean=value, violations=k))
            rows.append(row(f"{name} | none", k, "none", return_mean=-value, safety_rate=0.1 * k))
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


def test_agents_are_told_without_a_filter_that_their_env_has_not(tmp_path):
    given = {**ONE, "filters": ["default", "promise:p=0.9", "none"]}
    read = read_study(written(tmp_path / "s.yml", given))
    rows = [row("one | default", 0, "scbf", violations=3), row("one | none", 0, "none")]
    first, second = summaries(
        StudyResult(Study([SCALAR], read.variants), rows, {}), read.agents, SCALAR
    )
    assert (first.filter, second.filter) == ("scbf", "promise:p=0.9")
    assert second.estimates["safety"] is None
    for each in (first, second):
        # Those of the agents, whatever filter they are evaluated with.
        assert each.estimates["violations"].value == 3.0
        assert each.estimates["safety_alone"].value == 0.5
    assert summaries(StudyResult(Study([SCALAR], read.variants), [], {}), read.agents, SCALAR) == []
