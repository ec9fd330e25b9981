"""Certified envelopes of closed loops: below what the controllers attain, close to it, and kept."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError
from safe_envs.arrays import checksum, reading, write_arrays
from safe_envs.files import VARIABLE
from safe_envs.filters.conditions.text import conditions_for
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.registry import make_problem
from safe_envs.values import closed_loop
from safe_envs.values.closed_loop import (
    ClosedLoop,
    ExecutedInputs,
    closed_loop_for,
    closed_loop_table,
    load_closed_loop,
    require_few_states,
    save_closed_loop,
)
from safe_envs.values.tables import ValueFileError
from tests.values.systems import quadrature, scalar, x

POINTS = (np.linspace(0.05, 1.95, 40),)


@pytest.mark.parametrize("sigma", [0.4, 0.2 + 0.3 * x**2])
def test_a_policy_without_a_filter(sigma):
    problem = scalar(sp.sin(3 * x), sigma, nominal=sp.Rational(1, 2))
    q, exact = quadrature(problem, np.array([0.5]), (0.0, 2.0))
    gaps = []
    for cells in (60, 240):
        table = closed_loop_table(problem, None, "nominal", (cells,))
        bounds = table.start_bounds((q,))
        assert (bounds <= exact[0] + 1e-9).all()
        for k, values in enumerate(exact):
            assert (table.lower[k, table.grid.cell_of([q])] <= values + 1e-9).all()
        gaps.append((exact[0] - bounds).mean())
    # Where noise is divided into boxes, theirs is the larger part of the gap.
    assert gaps[1] < (0.4 if sigma == 0.4 else 0.9) * gaps[0]
    assert table.start_bounds((np.array([-0.5, 0.0, 2.5]),)).tolist() == [0, 0, 0]
    assert table.start_bounds((np.zeros(0),)).shape == (0,)


def test_any_policy_is_bounded_by_the_worst_one():
    problem = scalar(0, 0.3)
    lower = closed_loop_table(problem, None, "any", (200,)).start_bounds(POINTS)
    worst = np.ones(40)
    for u in (-1, 0, 1):
        own = closed_loop_table(scalar(0, 0.3, nominal=u), None, "nominal", (200,))
        worst = np.minimum(worst, own.start_bounds(POINTS))
    assert (lower <= worst + 1e-7).all()
    assert lower.max() > 0.3
    # A filter takes inputs away from it.
    condition = conditions_for(problem, "scbf")[0]
    filtered = closed_loop_table(problem, condition, "any", (200,)).start_bounds(POINTS)
    assert (filtered >= lower - 1e-6).all()
    assert filtered.mean() > lower.mean() + 0.05


def test_two_coordinates():
    problem = make_problem("safe_envs/CubicSDEDisk-v0", horizon=0.02)
    condition = conditions_for(problem, "scbf")[0]
    nominal, anything = (
        closed_loop_table(problem, condition, policy, (40, 40)) for policy in ("nominal", "any")
    )
    points = (np.array([0.0, 0.3]), np.array([0.0, -0.4]))
    assert (anything.start_bounds(points) <= nominal.start_bounds(points) + 1e-6).all()
    assert anything.start_bounds(points).min() > 0.9
    assert 0.3 < nominal.mean_over_starts(problem) < nominal.lower[0].max()


PROBLEMS = {
    "noise": lambda: scalar(x, 0.3, nominal=-2 * x),
    # The effect of the input on h changes its sign at x = 1/2, and vanishes at x = -1.
    "two signs": lambda: scalar(
        0, 0.2, barriers=x * (1 - x) + 0.5, gain=x + 1, nominal=sp.sin(5 * x)
    ),
    "mostly infeasible": lambda: scalar(3, 0.2, barriers=1 - x, nominal=1),
}


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("policy", ["any", "nominal"])
@pytest.mark.filterwarnings("ignore::safe_envs.SystemDefinitionWarning")
def test_what_the_filter_executes_is_in_the_intervals(name, policy):
    rng, problem = np.random.default_rng(3), PROBLEMS[name]()
    condition = conditions_for(problem, "scbf")[0]
    low = rng.uniform(-1.0, 1.9, 200)
    high = low + rng.exponential(0.05, 200)
    first, last = ExecutedInputs(problem, condition, policy).of_boxes([low], [high])
    assert (first >= -1).all()
    assert (last <= 1).all()
    filter_ = SafetyFilter.for_problem(problem, condition)
    law = sp.lambdify(x, problem.model.numeric(problem.nominal[0]))
    for _ in range(20):
        states = rng.uniform(low, high)
        own = np.clip(np.broadcast_to(law(states.astype(np.float32)), 200), -1.0, 1.0)
        proposed = own if policy == "nominal" else rng.uniform(-1.0, 1.0, 200)
        action = filter_.filter(states[:, None], proposed[:, None]).action[:, 0]
        assert (action >= first).all()
        assert (action <= last).all()
    # They say something.
    assert (last - first).mean() < 1.9


def loop(sigma: Any = 0.3, condition: str | None = "scbf", policy="nominal", knowledge="model"):
    problem = scalar(0, sigma)
    given = conditions_for(problem, condition)[0] if condition else None
    return ClosedLoop(problem, given, policy, knowledge)


def test_the_filter_knows_what_it_is_given():
    problem = make_problem("safe_envs/CubicSDEDisk-v0", model={"a": 2.0})
    condition = conditions_for(problem, "scbf")[0]
    loops = [ClosedLoop(problem, condition, "nominal", knows) for knows in ("model", "plant")]
    at = [each.ravel() for each in np.meshgrid(*[np.linspace(-0.9, 0.9, 20)] * 2)]
    model, plant = (each.executed.of_boxes(at, at)[0] for each in loops)
    assert abs(model - plant).max() > 0.1
    assert loops[0].fingerprint() != loops[1].fingerprint()


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


@pytest.mark.parametrize(
    ("call", "fragment"),
    [
        (lambda: closed_loop_table(make_problem("Quadrotor-v0"), None, "nominal"), "4 inputs"),
        (lambda: require_few_states(make_problem("Quadrotor-v0")), "4 inputs"),
        (lambda: require_few_states(make_problem("StochasticDubins-v0")), "3 states"),
        (lambda: closed_loop_table(scalar(), None, "best"), "'best'"),
        (
            lambda: closed_loop_table(
                (two := scalar(barriers=(x, 2 - x))), conditions_for(two, "scbf")[0], "any"
            ),
            "2 barriers",
        ),
        (lambda: loop(condition="scbf:sampling_margin=first-order").table(None), r"a u \+ b"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_what_is_not_bounded_is_refused(call, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        call()


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(closed_loop, "CELLS", {1: 60, 2: 400})
    return tmp_path / "cache" / closed_loop.FOLDER


def computed(done):
    """Whether a table was computed, by the progress that was told."""
    return len(done) > 1


def test_a_table_is_computed_once_and_kept(cache):
    first, second = [], []
    table = closed_loop_for(loop(), first.append)
    bounds = table.start_bounds(POINTS)
    assert (first[-1], computed(first)) == (1.0, True)
    assert bounds.max() > 0.1
    assert closed_loop_for(loop()) is table
    del table
    again = closed_loop_for(loop(), second.append)
    assert not computed(second)
    assert (again.start_bounds(POINTS) == bounds).all()
    assert again.lower.shape == (2, again.grid.cells)
    assert len(list(cache.glob("*.npz"))) == 1


def test_a_table_in_use_needs_no_folder(cache, monkeypatch):
    monkeypatch.setenv(VARIABLE, "")
    table = closed_loop_for(loop(sigma=0.25))
    assert closed_loop_for(loop(sigma=0.25)) is table


@pytest.mark.parametrize("how", ["short", "altered", "large", "other", "grid", "kind"])
def test_a_damaged_file_is_no_table(cache, tmp_path, how, caplog):
    own = loop(sigma=0.2) if how == "other" else loop()
    table = own.table(own.grid((30,)) if how == "grid" else own.grid())
    path = tmp_path / "a.npz"
    save_closed_loop(table, own, path)
    if how == "short":
        path.write_bytes(path.read_bytes()[:-100])
    elif how in ("altered", "large", "kind"):
        with reading(path, "the test") as content:
            header, arrays = json.loads(json.dumps(content.header)), content.arrays()
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
    (kept,) = cache.glob("*.npz")
    path.replace(kept)
    assert (closed_loop_for(loop()).start_bounds(POINTS) == right).all()
    assert "computed again" in caplog.text
