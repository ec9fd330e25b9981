from __future__ import annotations

import numpy as np
import pytest

from safe_envs.rendering.scenes.quadrotor import rotation
from tests.conftest import problem_of


def test_the_drawn_quadrotor_leans_where_its_thrust_goes():
    plant = problem_of("safe_envs/Quadrotor-v0").plant
    by_name = {s.name: s for s in plant.states}
    for angles in np.random.default_rng(0).uniform(-1.4, 1.4, (5, 3)):
        at = dict(zip((by_name[name] for name in ("phi", "theta", "psi")), angles, strict=True))
        push = np.array(plant.numeric(plant.input_matrix).subs(at), dtype=float)[3:6].sum(axis=1)
        turned = rotation(*angles)
        assert turned[:, 2] == pytest.approx(push / np.linalg.norm(push))
        assert turned @ turned.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(turned) == pytest.approx(1.0)
