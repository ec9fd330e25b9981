"""True claims of invariance are proved, false ones refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE
from safe_envs.enclosures.intervals import Interval
from safe_envs.problem.backup import BackupLaw
from safe_envs.proofs.backup_sets import Conditions, Disturbance, Ellipsoid, held_law, is_kept

x, v, u = sp.symbols("x v u", real=True)
NOTHING = Disturbance(*[Interval(np.zeros(0), np.zeros(0))] * 2)


def scalar(rate, law=-x):
    """Return x' = rate(x) + u under a held law, for periods of .1 s."""
    system = ControlAffineSDE((x,), (u,), [rate], [1], [[0]])
    return held_law(system, BackupLaw("law", (law,), equilibrium={x: 0}), 0.1, 1).blocks[0]


def interval(half, center=0.0):
    return Ellipsoid(np.array([center]), np.eye(1), half**2)


def kept(block, e, conditions=()):
    return is_kept(block, Conditions(block, conditions), e, NOTHING)


def test_a_contraction_keeps_every_interval_and_an_expansion_none():
    for half in (1e-6, 1.0, 1e6):
        assert kept(scalar(sp.Integer(0)), interval(half))
        assert not kept(scalar(sp.Integer(0), x), interval(half))
        assert not kept(scalar(sp.Integer(0), sp.Integer(0)), interval(half))


def test_a_law_that_overshoots_too_far_is_refused():
    # Under a held input x becomes x (1 - .1 gain): the gain 20 turns it around.
    for gain, truth in ((19.99, True), (20.01, False)):
        assert kept(scalar(sp.Integer(0), -gain * x), interval(1.0)) == truth


def test_the_edge_of_a_region_of_attraction_is_not_crossed():
    # x' = x^3 - x_0 over a period: contracting as far as its slope is below 1.
    block = scalar(x**3)
    assert kept(block, interval(0.5))
    assert not kept(block, interval(1.01))


def test_cells_prove_what_one_box_does_not():
    # The slope of x -> x - .2 sin(x) cos(x) is in [.8, 1.2] on all of the line, < 1 below pi/4.
    block = scalar(sp.Integer(0), -2 * sp.sin(x) * sp.cos(x))
    assert kept(block, interval(0.98 * math.pi / 4))
    assert not kept(block, interval(1.02 * math.pi / 4))


def test_a_set_away_from_the_fixed_point_is_kept_if_it_is_large_enough():
    # x becomes .9 x: around a center of .1 the displacement is .01, which a half width of .1 takes.
    block = scalar(sp.Integer(0))
    assert kept(block, interval(0.1001, 0.1))
    assert not kept(block, interval(0.0999, 0.1))


@pytest.mark.parametrize("excess", [1e-6, -1e-6])
def test_what_is_to_be_positive_is_so_to_the_edge(excess):
    block = scalar(sp.Integer(0))
    for q in (1 - x, 1 + x, 1 - x**2, sp.Min(1 - x, 2 + x), 1 - sp.Abs(x)):
        assert kept(block, interval(1.0 + excess), [q]) == (excess < 0)


def test_a_linear_condition_is_judged_on_the_ellipsoid_not_on_its_box():
    system = ControlAffineSDE((x, v), (u,), [-x, -v], [0, 0], [[0], [0]])
    law = BackupLaw("law", (sp.Integer(0),), equilibrium={x: 0, v: 0})
    block = held_law(system, law, 0.1, 1).blocks
    assert len(block) == 2
    coupled = ControlAffineSDE((x, v), (u,), [-x + v / 100, -v + x / 100], [0, 0], [[0], [0]])
    (block,) = held_law(coupled, law, 0.1, 1).blocks
    for level, truth in ((0.99, True), (1.01, False)):
        e = Ellipsoid(np.zeros(2), np.eye(2), level)
        assert kept(block, e, [math.sqrt(2) - x - v]) == truth


def test_what_has_no_value_is_refused():
    block = scalar(sp.Integer(0))
    assert not kept(block, interval(1.0), [sp.log(x + 0.5) + 10])
    assert not kept(scalar(1 / (x - 0.5) + 2), interval(1.0))


def test_a_disturbance_must_not_push_out():
    system = ControlAffineSDE((x, v), (u,), [-x, x - v], [0, 0], [[0], [0]])
    law = BackupLaw("law", (sp.Integer(0),), equilibrium={x: 0, v: 0})
    block = held_law(system, law, 0.1, 1).blocks[1]
    for half, truth in ((0.9, True), (1.06, False)):
        bounds = Interval(np.array([-half]), np.array([half]))
        assert (
            is_kept(block, Conditions(block, []), interval(1.0), Disturbance(bounds, bounds))
            == truth
        )
