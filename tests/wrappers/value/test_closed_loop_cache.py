"""Tables of closed loops are kept, and only those of the same closed loop are read again."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError
from safe_envs.arrays import checksum, write_arrays
from safe_envs.filters.conditions.text import conditions_for
from safe_envs.registry import make_problem
from safe_envs.values import closed_loop
from safe_envs.values.closed_loop import (
    ClosedLoop,
    closed_loop_for,
    load_closed_loop,
    require_few_states,
    save_closed_loop,
)
from safe_envs.values.tables import ValueFileError
from tests.wrappers.value.systems import scalar

POINTS = (np.linspace(0.05, 1.95, 40),)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SAFE_ENVS_CACHE", str(tmp_path))
    monkeypatch.setattr(closed_loop, "CELLS", {1: 60, 2: 400})
    closed_loop._IN_USE.clear()


def loop(sigma: Any = 0.3, condition: str | None = "scbf", policy="nominal", knowledge="model"):
    problem = scalar(0, sigma)
    given = conditions_for(problem, condition)[0] if condition else None
    return ClosedLoop(problem, given, policy, knowledge)


def files(tmp_path):
    return sorted((tmp_path / closed_loop.FOLDER).glob("*.npz"))


def refuse(*_, **__):
    raise AssertionError("it is computed again")


def test_a_second_process_reads_what_the_first_one_kept(tmp_path, monkeypatch):
    done = []
    bounds = closed_loop_for(loop(), done.append).start_bounds(POINTS)
    assert done[-1] == 1.0
    assert bounds.max() > 0.1
    # Nothing of this process holds the table any longer.
    assert not closed_loop._IN_USE
    monkeypatch.setattr(ClosedLoop, "table", refuse)
    found = closed_loop_for(loop())
    assert (found.start_bounds(POINTS) == bounds).all()
    assert found.lower.shape == (2, found.grid.cells)
    assert len(files(tmp_path)) == 1


def test_a_table_in_use_needs_no_folder(monkeypatch):
    monkeypatch.setenv("SAFE_ENVS_CACHE", "")
    table = closed_loop_for(loop())
    assert closed_loop_for(loop()) is table
    del table
    assert not closed_loop._IN_USE


def test_each_closed_loop_has_a_table_of_its_own():
    others = [
        loop(),
        loop(sigma=0.2),
        loop(condition=None),
        loop(condition="cbf:alpha=2"),
        loop(policy="any"),
    ]
    assert len({each.fingerprint() for each in others}) == len(others)
    assert loop().fingerprint() == loop().fingerprint()


def test_the_filter_knows_what_it_is_given():
    problem = make_problem("safe_envs/CubicSDEDisk-v0", model={"a": 2.0})
    condition = conditions_for(problem, "scbf")[0]
    loops = [ClosedLoop(problem, condition, "nominal", knows) for knows in ("model", "plant")]
    box = [each.ravel() for each in np.meshgrid(*[np.linspace(-0.9, 0.9, 20)] * 2)]
    model, plant = (each.executed.of_boxes(box, box)[0] for each in loops)
    assert abs(model - plant).max() > 0.1
    assert loops[0].fingerprint() != loops[1].fingerprint()


@pytest.mark.parametrize("how", ["short", "altered", "large", "other", "grid", "kind"])
def test_a_damaged_file_is_no_table(tmp_path, how, caplog):
    own = loop(sigma=0.2) if how == "other" else loop()
    grid = own.grid((30,)) if how == "grid" else own.grid()
    table = own.table(grid)
    path = tmp_path / "a.npz"
    save_closed_loop(table, own, path)
    if how == "short":
        path.write_bytes(path.read_bytes()[:-100])
    elif how in ("altered", "large", "kind"):
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays.pop("header").tobytes())
        arrays["lower"] = np.full_like(arrays["lower"], 1.5 if how == "large" else 0.99)
        if how != "altered":
            header.pop("sha256")
            header["kind"] = "values" if how == "kind" else header["kind"]
            header["sha256"] = checksum(header, arrays)
        write_arrays(path, header, arrays)
    with pytest.raises(ValueFileError, match="closed-loop"):
        load_closed_loop(path, loop(), loop().grid())
    # In the cache it is computed again.
    right = closed_loop_for(loop()).start_bounds(POINTS)
    (kept,) = files(tmp_path)
    path.replace(kept)
    assert (closed_loop_for(loop()).start_bounds(POINTS) == right).all()
    assert "computed again" in caplog.text


def test_suitable_cells_are_bounded_by_the_instants(monkeypatch):
    monkeypatch.setattr(closed_loop, "_WORK", 20 * scalar().steps)
    assert loop().grid().cells < 30
    assert loop().grid((200,)).cells >= 200


def test_many_starts_are_bounded_in_parts(monkeypatch):
    table = loop().table(loop().grid())
    whole = table.start_bounds(POINTS)
    monkeypatch.setattr(closed_loop, "_STARTS_AT_ONCE", 7)
    assert (table.start_bounds(POINTS) == whole).all()
    assert table.start_bounds((np.zeros(0),)).shape == (0,)


@pytest.mark.parametrize(
    ("env", "message"), [("Quadrotor", "4 inputs"), ("StochasticDubins", "3 states")]
)
def test_large_problems_are_refused(env, message):
    with pytest.raises(ConfigurationError, match=message):
        require_few_states(make_problem(f"safe_envs/{env}-v0"))


def test_zero_is_a_formula():
    zero = loop(policy="zero").executed
    low, high = zero.of_boxes([np.array([1.0])], [np.array([1.0])])
    own = ClosedLoop(scalar(0, 0.3, nominal=sp.Integer(0)), None, "nominal").executed
    bare = ClosedLoop(scalar(0, 0.3), None, "zero").executed
    ends = own.of_boxes([np.array([1.0])], [np.array([1.0])])
    assert bare.of_boxes([np.array([1.0])], [np.array([1.0])]) == ends
    assert low <= high
