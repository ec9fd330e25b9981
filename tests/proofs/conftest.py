"""Searches of proofs, which are short where a test is not about them."""

from __future__ import annotations

import pytest

from tests.proofs.verified import hurry


@pytest.fixture
def whole_search() -> None:
    """Leaves the search as it is."""


@pytest.fixture(autouse=True)
def short_search(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Searches less, except in oracles and for tests that ask for `whole_search`."""
    whole = "whole_search" in request.fixturenames
    if not whole and request.node.get_closest_marker("oracle") is None:
        hurry(monkeypatch)
