"""Rows with learned residuals: exact ones make the filter of the plant, and the margin covers what
errors can do."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from safe_envs import Barrier, ConfigurationError
from safe_envs.errors import RelativeDegreeError
from safe_envs.wrappers import HOCBF, LearnedHOCBF, SafetyFilter
from tests.conftest import problem_of
from tests.wrappers.learned import assert_same_decisions, residual_of, situations, worst_row


@pytest.mark.parametrize("name", ["DubinsDisk", "DubinsObstacle", "QuadrotorAltitude", "Quadrotor"])
def test_exact_residuals_make_the_filter_of_the_plant(name):
    problem = problem_of(f"safe_envs/{name}-v0")
    rates = problem.gains_of(0)
    ours = SafetyFilter.for_problem(problem, LearnedHOCBF(residual_of(problem), p=rates, eps=0.0))
    assert_same_decisions(problem, ours, SafetyFilter.for_problem(problem, HOCBF(rates), "plant"))
    if name != "DubinsObstacle":
        other = SafetyFilter.for_problem(problem, HOCBF(rates))
        x, u = situations(problem, 300)
        assert (
            abs(ours.filter(x, u).action - other.filter(x, u).action)
            > 1e-3 * np.ptp(problem.box, axis=1)
        ).any()


def test_the_margin_is_what_the_errors_can_do_to_one_input(disk):
    x, u = situations(disk, 2000)
    for errors, eps in (([0.1, 0.3, 0.5], None), ([0.2, 0.2, 0.2], 0.2)):
        condition = LearnedHOCBF(residual_of(disk, errors), p=disk.gains_of(0), eps=eps)
        found = SafetyFilter.for_problem(disk, condition).filter(x, u)
        assert found.feasible.mean() > 0.1
        # For one input nothing is given away.
        np.testing.assert_allclose(
            found.margin[:, 0], worst_row(disk, x, found.action, errors), atol=1e-10
        )
        assert found.margin[found.feasible].min() >= -1e-10
        assert (found.active[:, 0] & found.feasible).any()


def test_the_margin_covers_what_the_errors_can_do_to_several_inputs(rotors):
    x, u = situations(rotors, 1000)
    errors = [0.05, 0.2, 1e-6, 2e-6, 3e-6, 1e-6]
    condition = LearnedHOCBF(residual_of(rotors, errors), p=rotors.gains_of(0))
    found = SafetyFilter.for_problem(rotors, condition).filter(x, u)
    worst = worst_row(rotors, x, found.action, errors)
    size = abs(worst).max()
    assert found.feasible.mean() > 0.1
    assert (found.active[:, 0] & found.feasible).any()
    assert worst[found.feasible].min() >= -1e-12 * size
    # sqrt(m) |(e_j u_j)| is at most sqrt(m) times, and the plane above it at the far corner no more
    # than, sum e_j |u_j|.
    reach = np.array(errors[2:]) @ np.array(rotors.box)[:, 1]
    assert (found.margin[:, 0] <= worst + 1e-12 * size).all()
    assert (found.margin[:, 0] >= worst - 2.0 * reach - 1e-12 * size).all()
    plain = SafetyFilter.for_problem(
        rotors, LearnedHOCBF(residual_of(rotors, errors), p=rotors.gains_of(0), eps=0.0)
    ).filter(x, u)
    assert worst_row(rotors, x, plain.action, errors)[plain.feasible].min() < -1e-3


def test_the_level_chooses_the_quantile_of_the_held_out_errors(disk, residual):
    rows = []
    for level in (0.05, 0.95):
        condition = LearnedHOCBF(residual, p=disk.gains_of(0), level=level)
        rows.append(condition.constraint(disk.model, disk.barriers[0]))
        q: Any = rows[-1].uncertainty
        assert [float(e) for e in q] == pytest.approx(
            [0.0, 0.0, residual.parts[0].eps(level)[2] ** 2]
        )
    p_1, p_2 = disk.gains_of(0)
    low, high = (residual.parts[0].eps(level) for level in (0.05, 0.95))
    assert float(rows[0].offset - rows[1].offset) == pytest.approx(
        (p_1 + p_2) * (high - low)[0] + (high - low)[1]
    )
    exact = LearnedHOCBF(residual, p=disk.gains_of(0), eps=0.0).constraint(
        disk.model, disk.barriers[0]
    )
    assert exact.uncertainty is None


def test_what_does_not_suit_the_residuals_is_refused(disk, residual):
    with pytest.raises(ConfigurationError, match="first order"):
        SafetyFilter.for_problem(
            disk, LearnedHOCBF(residual, p=(1.0, 2.0), sampling_margin="first-order")
        )
    for rates in ((1.0,), (1.0, 2.0, 3.0)):
        with pytest.raises(RelativeDegreeError, match=f"relative degree 2.*{len(rates)} given"):
            SafetyFilter.for_problem(disk, LearnedHOCBF(residual, p=rates))
    other = replace(disk, barriers=(Barrier(disk.barriers[0].expression - 1, "smaller"),))
    with pytest.raises(ConfigurationError, match=r"learned for the barriers.*smaller"):
        SafetyFilter.for_problem(other, LearnedHOCBF(residual, p=(1.0, 2.0)))
    for settings in (
        {"eps": -0.1},
        {"eps": math.nan},
        {"eps": math.inf},
        {"eps": True},
        {"level": 0.0},
        {"level": 1.0},
        {"p": (1.0, -2.0)},
    ):
        with pytest.raises(ConfigurationError, match=next(iter(settings))):
            LearnedHOCBF(residual, **{"p": (1.0, 2.0), **settings})
