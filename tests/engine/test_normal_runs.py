"""Runs of normals are the normals one by one, to the bit."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.dynamics.normal_kernel import standard_normal
from safe_envs.engine import draws
from safe_envs.engine.draws import fill_normal_run, fill_normals
from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Program


@pytest.mark.parametrize("count", [0, 1, 7, 400])
def test_runs_are_the_numbers_one_by_one(count):
    functions = Program("normals", (fill_normal_run, fill_normals), Source("")).plain()
    run, single = np.empty(3 * count), np.empty(count)
    functions["fill_normal_run"](run, 8, 3, 1, 5, 6)
    functions["fill_normals"](single, 8, 3, 1, 5, 6)
    assert run[:count].tobytes() == single.tobytes()
    if count == 400:
        assert abs(single).max() > 2.0


def test_tails_of_all_kinds_find_their_places(monkeypatch):
    given = [0.0, 0.5, 2.0**-53, 1.0 - 2.0**-53, 0.075, 0.925, 1e-12, 1.0 - 1e-12, 0.3, 0.01]
    monkeypatch.setattr(draws, "fill_uniforms", lambda out, *_: np.copyto(out, np.array(given)))
    out = np.empty(3 * len(given))
    fill_normal_run(out, 0, 0, 0, 0, 0)
    assert out[: len(given)].tolist() == [standard_normal(u) for u in given]
