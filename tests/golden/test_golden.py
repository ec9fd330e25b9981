"""What commands and envs compute is what is stored in `rows` (see `run.py`)."""

from __future__ import annotations

import pytest

from safe_envs.files import own_cache
from tests.golden import run


@pytest.mark.oracle
@pytest.mark.parametrize("name", run.names())
def test_a_case_is_as_it_is_stored(name: str):
    with own_cache():
        found = run.compute(name)
    assert run.compared(name, found) == []


@pytest.mark.parametrize(
    ("stored", "got", "count"),
    [
        ({"a": 1.0, "b": [1, "x"]}, {"a": 1.0 + 1e-12, "b": [1, "x"]}, 0),
        ({"a": 1.0}, {"a": 1.0 + 1e-6}, 1),
        ({"a": 1}, {"a": 1.0}, 1),
        ({"a": [1, 2]}, {"a": [1], "b": None}, 2),
        ({"a": float("nan"), "b": True}, {"a": float("nan"), "b": 1}, 1),
    ],
)
def test_differences_are_seen(stored, got, count):
    assert len(list(run.differences(stored, got))) == count
