"""Boxes of normals: disjoint, with their probabilities."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from safe_envs.values.smoothing import noise_boxes


@pytest.mark.parametrize("counts", [(), (20,), (17, 11), (8, 4, 6)])
def test_boxes_hold_nearly_everything(counts):
    channels, boxes = len(counts), noise_boxes(counts)
    assert boxes.weights.sum() <= 1
    assert boxes.weights.sum() + boxes.rest >= 1 - 1e-12
    assert boxes.rest < 1e-5
    chances = np.prod(ndtr(boxes.high) - ndtr(boxes.low), axis=0)
    np.testing.assert_allclose(boxes.weights, chances, rtol=1e-9)
    if channels:
        w = np.random.default_rng(0).normal(size=(channels, 300))
        inside = (w[:, :, None] >= boxes.low[:, None]) & (w[:, :, None] < boxes.high[:, None])
        assert (inside.all(axis=0).sum(axis=1) == 1).all()
