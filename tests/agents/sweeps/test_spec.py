"""Files of sweeps, also of whoever wants to do harm: read, or refused with a short message."""

from __future__ import annotations

import math
import os
import time
from dataclasses import fields
from datetime import date
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as st
import pytest
import yaml

from safe_envs.agents.evaluation.spec import EvaluationSpec
from safe_envs.agents.sweeps.spec import describe, document_in, read_sweep, sweep_of
from safe_envs.errors import ConfigurationError, RelativeDegreeError

pytestmark = pytest.mark.slow

SMALL: dict[str, Any] = {"env": "Scalar-v0", "filter": "scbf", "episodes": 20, "horizon": 0.2}
SECONDS = 2.0


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "sweep.yaml"


def test_lists_multiply_and_single_cells_follow():
    grid = {"noise": [0.1, 0.2], "seed": [0, 1]}
    cells = [{"plant.sigma": 0.3, "dt": "1e-2"}]
    sweep = sweep_of({"fixed": SMALL, "grid": grid, "cells": cells})
    found = [(c.settings.get("noise"), c.settings["seed"]) for c in sweep.cells]
    assert found == [(0.1, 0), (0.1, 1), (0.2, 0), (0.2, 1), (None, 0)]
    assert sweep.swept == ("noise", "seed", "dt", "plant.sigma")
    last = sweep.cells[-1]
    # YAML reads 1e-2 as a word.
    assert last.options == {"dt": 0.01, "horizon": 0.2, "plant": {"sigma": 0.3}}
    assert describe(last, sweep.swept) == "seed = 0, dt = 0.01, plant.sigma = 0.3"
    assert last.settings["policy"] == "nominal"


def test_equal_cells_are_one():
    equal = {
        "noise": [1, 1.0, "1e0"],
        "start": [[0, 0.5], [-0.0, 0.5]],
        "barrier.limit": [1, 1.0],
        "seed": [2**53, 2**53 + 1],
    }
    again = {"noise": 1.0, "seed": 2**53, "barrier.limit": 1.0, "start": [0, 0.5]}
    found = sweep_of({"fixed": SMALL, "grid": equal, "cells": [again]})
    assert found.swept == ("seed",)
    assert len(found.cells) == 2
    keys = {
        sweep_of({"fixed": {**SMALL, **more}}).cells[0].key
        for more in ({"noise": 1}, {"env": "safe_envs/Scalar-v0", "noise": 1.0})
    }
    assert len(keys) == 1


def test_every_field_of_an_evaluation_is_a_setting():
    settings = {"env": "Scalar-v0", "filter": "none", "monitoring": "continuous", "confidence": 0.9}
    (cell,) = sweep_of({"fixed": settings}).cells
    assert (cell.spec.monitoring, cell.spec.confidence) == ("continuous", 0.9)
    names = {field.name for field in fields(EvaluationSpec)} - set(cell.settings)
    assert names == {"problem", "filters", "options", "filter_spec", "learned", "trust"}


@pytest.mark.parametrize(
    ("document", "fragment"),
    [
        ([1], "fixed, grid, cells"),
        ({"env": "Scalar-v0", "grid": {"filter": ["none"]}}, "fixed"),
        ({"gird": {}}, "'grid'"),
        ({"fixed": {"nosie": 0.1}}, "'noise'"),
        ({"fixed": {"plant": 1}}, r"plant\.NAME"),
        ({"fixed": SMALL, "grid": {"noise": 0.1}}, "noise"),
        ({"fixed": SMALL, "grid": {"noise": []}}, "noise"),
        ({"fixed": SMALL, "grid": {"horizon": [1, 2]}}, "horizon is fixed"),
        ({"fixed": SMALL, "grid": {"seed": date(2026, 1, 1)}}, 'seed = "2026-01-01"'),
        ({"fixed": SMALL, "grid": {"noise": [None]}}, "noise = null"),
        ({"fixed": SMALL, "grid": {"noise": [math.nan]}}, "noise = nan"),
        (
            {"fixed": SMALL, "grid": {f"plant.p{k}": list(range(100)) for k in range(4)}},
            "100000000",
        ),
        ({"fixed": SMALL, "cells": {"noise": 1}}, "cells"),
        ({"fixed": SMALL, "cells": date(2026, 1, 1)}, "cells"),
        ({"fixed": SMALL, "cells": [{"noise": "much"}]}, 'entry 1: noise = "much"'),
        ({"fixed": {**SMALL, "episodes": 0}}, "episodes = 0"),
        ({"fixed": {**SMALL, "bounds": 1}}, "bounds = 1"),
        ({"fixed": {**SMALL, "policy": 3}}, "policy = 3"),
        ({"fixed": {**SMALL, "env": True}}, "env = true"),
        ({"fixed": {date(2026, 1, 1): 1}}, "fixed"),
        ({"fixed": {"filter": "scbf", "system": "mine:problem"}}, r"system = mine.*FILE\.py"),
        ({"fixed": {"env": "Scalar-v0"}}, "filter"),
        ({"fixed": {"filter": "scbf"}}, "env"),
    ],
)
def test_mistakes_in_the_form_are_said(document: Any, fragment: str):
    with pytest.raises(ConfigurationError, match=fragment):
        sweep_of(document)


@pytest.mark.parametrize(
    ("grid", "fragment"),
    [
        ("filter: [scbf, scfb]", "filter = scfb: .*'scbf'"),
        ("env: [Scalar-v0, Scaler-v0]", "'safe_envs/Scalar-v0'"),
        ("policy: [nominal, nominel]", "'nominal'"),
        ("noise: [.1, -.1]", "cell noise = -0.1"),
        ("plant.sigma: [.1, 0]\n  plant.sgma: [1]", "sgma"),
        ("knowledge: [model, plnt]", "'plant'"),
        ("filter: [scbf, 'ddscbf:file=there-is-none.npz']", "there-is-none.npz"),
        (
            "filter: [none, scbf]\n  env: [StochasticDubins-v0]\n  objective: [nearest, clf]",
            "= clf",
        ),
        # Each env goes with one of the filters, and each filter with one of the envs.
        (
            "filter: [scbf, srcbf]\n  env: [Scalar-v0, StochasticDubins-v0]",
            "cell .*StochasticDubins-v0, filter = srcbf",
        ),
    ],
)
def test_mistakes_in_a_value_are_found_before_the_first_cell(file: Path, grid: str, fragment: str):
    kept = [f"  {name}: {value}" for name, value in SMALL.items() if f"{name}: [" not in grid]
    file.write_text("\n".join(["fixed:", *kept, "grid:", f"  {grid}"]))
    with pytest.raises((ConfigurationError, RelativeDegreeError), match=fragment):
        read_sweep(file)


BOMB = "fixed:\n  start: &a [1,1]\ngrid:\n" + "".join(
    f"  plant.p{i}: &p{i} [{','.join(['*' + ('a' if i == 0 else f'p{i - 1}')] * 10)}]\n"
    for i in range(8)
)
MANY = (
    f"fixed: {{env: Scalar-v0, filter: none}}\ngrid: {{seed: [{'1,' * 800}], dt: [{'2,' * 800}]}}"
)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("a: [", "YAML"),
        ("fixed: {seed: 1}\ngrid: {seed: [1]}\nfixed: {}", "'fixed' is given twice"),
        ("grid:\n  filter: [none]\n  filter: [scbf]", "line 3"),
        *((f"grid: {{seed: [{text}]}}", text) for text in ("010", "1:30", "1_000", "0x10")),
        (BOMB, "alias"),
        ("fixed: &a {start: [*a]}", "alias"),
        ("[" * 3000 + "]" * 3000, "nested"),
        ("- " * 3000 + "x", "nested"),
        ("{" * 3000, "nested"),
        ("? [a, b]\n: 1", "a list or a mapping"),
        ("? {a: b}\n: 1", "a list or a mapping"),
        ("fixed: {bounds: !!bool foo}", "tag"),
        ("fixed: {dt: !!timestamp foo}", "tag"),
        ("fixed: !!python/object/apply:os.system [echo hi]", "tag"),
        ("fixed: {dt: 2001-13-45}", 'dt = "2001-13-45"'),
        ("fixed: {episodes: " + "9" * 5000 + "}", "episodes = inf"),
        ("fixed: {dt: " + "9" * 400 + "}", "dt = inf"),
        ("fixed: {dt: 1_0.5}", "1_0.5"),
        ("fixed: {dt: 1:30.5}", "1:30.5"),
        ("fixed: {dt: ٣}", "dt"),
        ("fixed: {dt: '1_0'}", "dt"),
        ("fixed: {policy: 'a', system: \"a\\0b.py:x\"}", "character"),
        ("fixed: {env: Scalar-v0, filter: cbf, policy: " + "x" * 300 + "}", "policy"),
        ("fixed: {system: " + "x" * 60_000 + "}", "FILE.py:NAME"),
        ("x" * 60_000 + ": 1", "YAML"),
        ("a" * 70_000, "larger"),
        (MANY, "640000"),
    ],
    ids=lambda text: text[:24],
)
def test_bombs_and_what_is_no_sweep_are_refused_at_once(file: Path, content: str, reason: str):
    file.write_text(content)
    began = time.process_time()
    with pytest.raises(ConfigurationError) as raised:
        read_sweep(file)
    assert time.process_time() - began < SECONDS
    assert reason in str(raised.value)
    assert len(str(raised.value)) < 1000


def test_the_largest_files_are_read_at_once_and_others_are_none(file: Path):
    # This takes the longest for its length.
    file.write_text("[" + "? ," * 21_000 + "]")
    began = time.process_time()
    assert len(document_in(file)) == 21_000
    assert time.process_time() - began < SECONDS
    file.unlink()
    for make in (lambda: None, lambda: os.mkfifo(file)):
        make()
        with pytest.raises(ConfigurationError, match=r"sweep\.yaml"):
            read_sweep(file)


words = st.text(st.characters(codec="ascii"), max_size=5)
scalars = (
    st.none() | st.booleans() | st.integers(-(10**30), 10**30) | st.floats(-1e10, 1e10) | words
)
mappings = st.dictionaries(st.text("abc", max_size=3), scalars, max_size=3)
documents = st.recursive(
    scalars | mappings,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
)
each_file = hypothesis.settings(
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture]
)


@each_file
@hypothesis.given(document=documents)
def test_what_json_can_say_is_read_as_it_was_written_and_is_a_sweep_or_refused(document, file):
    # PyYAML may write equal texts as aliases, and texts that look like numbers in odd forms with
    # tags.
    file.write_text(yaml.safe_dump(document))
    assert document_in(file) == document
    with pytest.raises(ConfigurationError) as raised:
        sweep_of(document)
    assert 0 < len(str(raised.value)) < 1000


@each_file
@hypothesis.given(text=st.text(alphabet="ab1.:-?{}[],&*!|>'\"#\n _", max_size=40))
def test_any_text_is_refused(text: str, file: Path):
    file.write_text(text)
    with pytest.raises(ConfigurationError):
        read_sweep(file)
