"""The slower methods that decide where the usual one gives up, which hardly any QP needs."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from safe_envs.engine.qp import plane
from safe_envs.engine.qp.kernels import many
from safe_envs.engine.qp.kernels import plane as plane_kernel
from tests.engine.test_qp import assert_equal
from tests.oracles.qps import Answers, QPs, by_batch, random_qps


def by_kernel(kernel, length: int, qps: QPs) -> Answers:
    """What a kernel says of one problem after the other, in a scratch array that holds rubbish."""
    size, k, m = qps.a.shape
    found = Answers(np.empty((size, m)), np.empty((size, k)), np.empty((size, k)), np.empty(size))
    work = np.full(length, np.nan)
    for i in range(size):
        rest = qps.priority, found.u[i], found.margin[i], found.active[i], work
        found.feasible[i] = kernel(*[part[i] for part in qps[:6]], *rest)
    return found


@pytest.mark.parametrize("kind", ["plain", "integers", "parallel", "flat", "touching"])
@pytest.mark.parametrize(
    ("module", "name", "value", "m"),
    [
        (plane_kernel, "NEWTON_STEPS", 0, 2),
        (many, "find_binding", lambda *_: False, 4),
        (plane, "_STEPS", 0, 2),
    ],
    ids=["kernel of two inputs", "kernel of many", "two inputs"],
)
def test_they_find_the_same_minimisers(module: ModuleType, name, value, m, kind, monkeypatch):
    qps = random_qps(np.random.default_rng(9), 60, 3, m, kind, 1.0)
    expected = by_batch(qps)
    monkeypatch.setattr(module, name, value)
    if module is plane:
        found = by_batch(qps)
    elif module is many:
        found = by_kernel(many.project_many, many.work_of_many(3, m), qps)
    else:
        found = by_kernel(plane_kernel.project_plane, plane_kernel.work_of_plane(3, m), qps)
    assert_equal(qps, found, expected)
    assert 2 < (~expected.feasible).sum() < 55
