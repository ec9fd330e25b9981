from __future__ import annotations

import math
import re
from dataclasses import fields, replace
from datetime import date
from pathlib import Path
from typing import Any

import pytest

from safe_envs.agents.evaluation.spec import EvaluationSpec
from safe_envs.agents.jobs.job import outcome_of
from safe_envs.agents.sweeps.spec import Cell, describe, read_sweep, sweep_of
from safe_envs.errors import ConfigurationError, RelativeDegreeError

SMALL: dict[str, Any] = {"env": "Scalar-v0", "filter": "scbf", "episodes": 20, "horizon": 0.2}


def written(folder: Path, text: str) -> Path:
    path = folder / "sweep.yaml"
    path.write_text(text)
    return path


def test_lists_multiply_and_single_cells_follow():
    sweep = sweep_of(
        {
            "fixed": SMALL,
            "grid": {"noise": [0.1, 0.2], "seed": [0, 1]},
            "cells": [{"plant.sigma": 0.3, "dt": "1e-2"}],
        }
    )
    assert [(c.settings.get("noise"), c.settings["seed"]) for c in sweep.cells] == [
        (0.1, 0),
        (0.1, 1),
        (0.2, 0),
        (0.2, 1),
        (None, 0),
    ]
    assert sweep.swept == ("noise", "seed", "dt", "plant.sigma")
    last = sweep.cells[-1]
    # YAML reads 1e-2 as a word.
    assert last.options == {"dt": 0.01, "horizon": 0.2, "plant": {"sigma": 0.3}}
    assert describe(last, sweep.swept) == "seed = 0, dt = 0.01, plant.sigma = 0.3"
    assert last.settings["policy"] == "nominal"


def test_equal_cells_are_one():
    assert (
        len(
            sweep_of(
                {"fixed": SMALL, "grid": {"noise": [0.1, 0.1]}, "cells": [{"noise": 0.1}]}
            ).cells
        )
        == 1
    )
    assert len(sweep_of({"fixed": SMALL}).cells) == 1
    equal = {
        "noise": [1, 1.0, "1e0"],
        "start": [[0, 0.5], [-0.0, 0.5]],
        "barrier.limit": [1, 1.0],
        "seed": [2**53, 2**53 + 1],
    }
    found = sweep_of(
        {
            "fixed": SMALL,
            "grid": equal,
            "cells": [{"noise": 1.0, "seed": 2**53, "barrier.limit": 1.0, "start": [0, 0.5]}],
        }
    )
    assert found.swept == ("seed",)
    assert len(found.cells) == 2
    (one,) = sweep_of({"fixed": {**SMALL, "noise": 1}}).cells
    assert (
        one.key
        == sweep_of({"fixed": {**SMALL, "env": "safe_envs/Scalar-v0", "noise": 1.0}}).cells[0].key
    )


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([1], "give the sections fixed, grid, cells"),
        (
            {"env": "Scalar-v0", "grid": {"filter": ["none"]}},
            "a setting goes under fixed, a list of its values under grid",
        ),
        ({"gird": {}}, "did you mean 'grid'"),
        ({"fixed": {"nosie": 0.1}}, "did you mean 'noise'"),
        ({"fixed": {"plant": 1}}, "give its parameters as plant.NAME"),
        ({"fixed": SMALL, "grid": {"noise": 0.1}}, "give a list of values"),
        ({"fixed": SMALL, "grid": {"noise": []}}, "give a list of values"),
        ({"fixed": SMALL, "grid": {"horizon": [1, 2]}}, "horizon is fixed"),
        ({"fixed": SMALL, "cells": {"noise": 1}}, "give a list, each entry with settings"),
        ({"fixed": SMALL, "cells": [{"noise": "much"}]}, 'entry 1: noise = "much"; give a number'),
        ({"fixed": {**SMALL, "episodes": 0}}, "give a whole number from 1"),
        ({"fixed": {**SMALL, "bounds": 1}}, "give true or false"),
        ({"fixed": {**SMALL, "policy": 3}}, "policy = 3; give a text"),
        (
            {"fixed": SMALL, "grid": {"seed": date(2026, 1, 1)}},
            'seed = "2026-01-01"; give a list of values',
        ),
        ({"fixed": SMALL, "cells": date(2026, 1, 1)}, "give a list, each entry with settings"),
        ({"fixed": {date(2026, 1, 1): 1}}, "give NAME: VALUE entries"),
        ({"fixed": {**SMALL, "env": True}}, "env = true; give a text"),
        ({"fixed": SMALL, "grid": {"noise": [None]}}, "noise = null; give a number"),
        ({"fixed": SMALL, "grid": {"noise": [math.nan]}}, "noise = nan; give a finite number"),
        (
            {"fixed": {"filter": "scbf", "system": "mine:problem"}},
            "system = mine:problem; give FILE.py:NAME",
        ),
        ({"fixed": {"env": "Scalar-v0"}}, "has no filter"),
        ({"fixed": {"filter": "scbf"}}, "one of the two"),
        (
            {"fixed": SMALL, "grid": {f"plant.p{k}": list(range(100)) for k in range(4)}},
            "the most are",
        ),
    ],
)
def test_mistakes_in_the_form_are_said(document: Any, message: str):
    with pytest.raises(ConfigurationError, match=message.replace("[", r"\[")):
        sweep_of(document)


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        ("filter: [scbf, scfb]", "filter = scfb: unknown filter 'scfb'; did you mean 'scbf'"),
        ("env: [Scalar-v0, Scaler-v0]", "did you mean 'safe_envs/Scalar-v0'"),
        ("policy: [nominal, nominel]", "did you mean 'nominal'"),
        ("noise: [.1, -.1]", "cell noise = -0.1: noise = -0.1"),
        ("plant.sigma: [.1, 0]\n  plant.sgma: [1]", "sgma"),
        ("knowledge: [model, plnt]", "did you mean 'plant'"),
        ("filter: [scbf, 'ddscbf:file=there-is-none.npz']", "there-is-none.npz cannot be read"),
        (
            "filter: [none, scbf]\n  env: [StochasticDubins-v0]\n  objective: [nearest, clf]",
            "= clf: .*no control Lyapunov function",
        ),
        # Each env goes with one of the filters, and each filter with one of the envs.
        (
            "filter: [scbf, srcbf]\n  env: [Scalar-v0, StochasticDubins-v0]",
            "cell .*StochasticDubins-v0, filter = srcbf: .*degree 2",
        ),
    ],
)
def test_mistakes_in_a_value_are_found_before_the_first_cell(
    tmp_path: Path, grid: str, message: str
):
    kept = [f"  {name}: {value}" for name, value in SMALL.items() if f"{name}: [" not in grid]
    path = written(tmp_path, "\n".join(["fixed:", *kept, "grid:", f"  {grid}"]))
    with pytest.raises((ConfigurationError, RelativeDegreeError), match=message):
        read_sweep(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [", "is no YAML"),
        (None, "cannot be read"),
        ("fixed: {seed: 1}\ngrid: {seed: [1]}\nfixed: {}", "'fixed' is given twice"),
        ("grid:\n  filter: [none]\n  filter: [scbf]", r"(?s)'filter' is given twice.*line 3"),
        *(
            (f"grid: {{seed: [{text}]}}", f"{text} is no plain number")
            for text in ("010", "1:30", "1_000", "0x10")
        ),
    ],
)
def test_files_that_are_none(tmp_path: Path, text: str | None, message: str):
    path = tmp_path / "sweep.yaml" if text is None else written(tmp_path, text)
    with pytest.raises(ConfigurationError, match=message):
        read_sweep(path)


def test_a_cell_is_known_by_all_that_its_result_hangs_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (cell,) = sweep_of({"fixed": SMALL}).cells
    (same,) = sweep_of({"fixed": dict(reversed(SMALL.items()))}).cells
    assert cell.key == same.key
    assert cell.key != replace(cell, settings={**cell.settings, "seed": 1}).key
    assert cell.key != replace(cell, versions={**cell.versions, "numpy": "0"}).key
    monkeypatch.chdir(tmp_path)
    of_file = {**SMALL, "system": "mine.py:problem"}
    del of_file["env"]
    keys = []
    for text in ("a = 1", "a = 2"):
        Path("mine.py").write_text(text)
        (made,) = sweep_of({"fixed": of_file}).cells
        assert made.settings["system"] == f"{tmp_path / 'mine.py'}:problem"
        keys.append(made.key)
    assert keys[0] != keys[1]


def test_a_worker_with_other_versions_or_files_computes_nothing(tmp_path: Path):
    (cell,) = sweep_of({"fixed": SMALL}).cells
    assert "numpy" in str(outcome_of(replace(cell, versions={**cell.versions, "numpy": "0"})).error)
    file = tmp_path / "file"
    file.write_text("text")
    assert "another content" in str(outcome_of(replace(cell, files={str(file): "0"})).error)
    assert "share" in str(outcome_of(replace(cell, files={str(tmp_path / "none"): "0"})).error)


def test_an_error_of_any_kind_is_the_outcome_of_its_cell():
    outcome = outcome_of(Cell({"env": "Scalar-v0"}))
    assert outcome.result is None
    assert re.fullmatch(
        r"KeyError: 'filter' \(at sweeps/cell\.py:\d+ in .*, from .*:\d+ in outcome_of\)",
        str(outcome.error),
    )


def test_every_field_of_an_evaluation_is_a_setting():
    settings = {"env": "Scalar-v0", "filter": "none", "monitoring": "continuous", "confidence": 0.9}
    (cell,) = sweep_of({"fixed": settings}).cells
    assert (cell.spec.monitoring, cell.spec.confidence) == ("continuous", 0.9)
    names = {field.name for field in fields(EvaluationSpec)}
    assert names - set(cell.settings) == {
        "problem",
        "filters",
        "options",
        "filter_spec",
        "learned",
        "trust",
    }
