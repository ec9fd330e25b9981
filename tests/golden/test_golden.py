"""What commands and envs compute is what is stored in `rows` (see `comparison.py`)."""

from __future__ import annotations

import pytest

from safe_envs.files import own_cache
from tests.golden import comparison


@pytest.mark.oracle
@pytest.mark.parametrize("name", comparison.names())
def test_a_case_is_as_it_is_stored(name: str, request: pytest.FixtureRequest):
    with own_cache():  # tables that the user has would be read
        found = comparison.compute(name)
    if request.config.getoption("--write", default=False) and "error" not in found:
        comparison.store(name, found)
    assert comparison.compared(name, found) == []


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
    assert len(list(comparison.differences(stored, got))) == count
