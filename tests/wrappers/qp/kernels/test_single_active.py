"""The kernel of three and more inputs with one binding constraint against the dispatcher."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.engine.qp.kernels import one_constraint as kernel
from tests.oracles.kernel_problems import KINDS, Problems, random_problems, reference, solve


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("k", "m"), [(2, 3), (3, 3), (2, 4)])
def test_says_what_the_dispatcher_does_where_it_can(k, m, kind):
    problems = random_problems(np.random.default_rng([k, m, KINDS.index(kind)]), 100, k, m, kind)
    solved = []

    def project(*arguments):
        answer = kernel.project_single_active(*arguments)
        solved.append(answer[0])
        return answer[1]

    found = solve(project, kernel.work_of_single_active(k, m), problems)
    chosen = np.flatnonzero(solved)
    assert chosen.size > (40 if kind in ("plain", "sizes", "far") else 10)
    expected = reference(Problems(*[part[chosen] for part in problems[:6]], problems.priority))
    assert expected.active.any(axis=1).sum() > 5
    # A proposal 1e8 boxes away has its own rounding.
    relative = 1e-7 if kind == "far" else 1e-11
    np.testing.assert_allclose(found.u[chosen], expected.u, rtol=relative, atol=relative)
    np.testing.assert_array_equal(found.active[chosen], expected.active)
    np.testing.assert_array_equal(found.feasible[chosen], expected.feasible)
    sizes = (np.abs(problems.a) @ np.abs(found.u)[:, :, None])[chosen, :, 0]
    sizes += np.abs(problems.b[chosen])
    assert np.all(np.abs(found.margin[chosen] - expected.margin) <= relative * sizes)
