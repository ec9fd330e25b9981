"""Inputs that are tried, boxes that cover all of them, and neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.values.input_search import scanned_inputs


@pytest.mark.parametrize("m", [1, 2, 3])
def test_inputs_and_boxes(m):
    box = [(-1.0, 2.0), (0.0, 1.0), (5.0, 7.0)][:m]
    scanned = scanned_inputs(box, None)
    for corner in np.stack(np.meshgrid(*box), axis=-1).reshape(-1, m):
        assert (scanned.values == corner).all(axis=1).any()
    low, high = np.array(box).T
    u = np.random.default_rng(0).uniform(low, high, (200, m))
    inside = (u[:, None] >= scanned.boxes[..., 0]) & (u[:, None] <= scanned.boxes[..., 1])
    assert inside.all(axis=2).any(axis=1).all()
    assert scanned.boxes.shape == scanned.ends.shape
    for i, near in enumerate(scanned.neighbours):
        apart = scanned.values[near[near >= 0]] - scanned.values[i]
        assert ((apart != 0).sum(axis=1) == 1).all()
        assert (near[near >= 0] != i).all()


def test_too_many_inputs_are_refused():
    with pytest.raises(ConfigurationError, match="inputs = 100: so many values"):
        scanned_inputs([(-1, 1)] * 3, 100)
