"""Backups of the shipped systems: their terminal sets are kept, and as large as exact kernels."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import quad

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.integrators import Integrator
from safe_envs.errors import ConfigurationError
from safe_envs.problem.backup import backup_of
from safe_envs.proofs.backup_sets import with_terminal_sets
from safe_envs.systems.backup_laws import circle_radius
from tests.conftest import problem_of


class Simulated:
    """The backup laws of a problem, executed as an env would, without noise."""

    def __init__(self, name, **options):
        quiet = {"noise": 0.0} if name.startswith("ACC") else {}
        self.problem = problem_of(f"safe_envs/{name}-v0", **quiet, **options)
        plant, self.laws = self.problem.plant, with_terminal_sets(self.problem, self.problem.plant)
        self.step = Integrator(plant, self.problem.dt, self.problem.substeps, "arrays")
        self.safe = compile_function(
            plant.states, [b.expression for b in self.problem.barriers], "arrays"
        )

    def terminal(self, law, x):
        known = compile_function(self.problem.plant.states, [law.terminal], "arrays")
        return stacked(known(*x), x.shape[1])[:, 0]

    def stays(self, law, x, steps):
        """Return the smallest barrier at control instants under a law, shape (N,)."""
        known = compile_function(self.problem.plant.states, law.law, "arrays")
        low, high = np.array(self.problem.input_bounds).T
        smallest = np.full(x.shape[1], np.inf)
        for _ in range(steps):
            smallest = np.minimum(smallest, stacked(self.safe(*x), x.shape[1]).min(axis=1))
            u = np.clip(stacked(known(*x), x.shape[1]), low, high).T
            x = np.stack(self.step.step(tuple(x), tuple(u), ()))
        return smallest, x


@pytest.mark.parametrize(
    ("name", "options", "low", "high"),
    [
        ("DubinsDisk", {"dt": 0.2, "input_bounds": (-2, 5)}, (-1, -1, -4), (1, 1, 4)),
        ("ACCGap", {"dt": 0.2, "distance": 30.0}, (0, 30), (50, 200)),
        ("ACC", {"tau": 0.5, "dt": 0.2}, (0, 0, 0), (50, 50, 300)),
        *(
            pytest.param(*case, marks=pytest.mark.oracle)
            for case in (
                ("DubinsDisk", {}, (-1, -1, -4), (1, 1, 4)),
                ("DubinsDisk", {"radius": 3.0, "substeps": 3}, (-3, -3, -4), (3, 3, 4)),
                ("ACCGap", {}, (0, 10), (50, 200)),
                ("ACCGap", {"plant": {"v_f": 5.0, "M": 900.0}}, (0, 10), (50, 200)),
                ("ACC", {}, (0, 0, 0), (50, 50, 300)),
            )
        ),
    ],
)
def test_a_terminal_set_is_safe_and_kept(name, options, low, high):
    known = Simulated(name, **options)
    for law in known.laws.laws:
        x = np.random.default_rng(0).uniform(low, high, (2000, len(low))).T
        x = x[:, known.terminal(law, x) >= 0.0]
        assert x.shape[1] > 100
        smallest, after = known.stays(law, x, 100)
        assert (smallest >= 0.0).all()
        assert (known.terminal(law, after) >= -1e-9).all()


def test_a_held_turn_makes_the_circle_that_is_said():
    known = Simulated("DubinsDisk", dt=0.3)
    rate, v = 3.0, known.problem.plant.parameter_values["v"]
    radius = circle_radius(v, rate, 0.3)
    x = np.array([[0.2], [-0.1], [0.7]])
    center = x[:2, 0] + radius * np.array([-math.sin(0.7), math.cos(0.7)])
    for _ in range(20):
        x = np.stack(known.step.step(tuple(x), (np.array([rate]),), ()))
        assert math.hypot(*(x[:2, 0] - center)) == pytest.approx(radius, rel=1e-12)
    assert circle_radius(v, rate, 1e-3) == pytest.approx(v / rate, rel=1e-12)
    assert 0 < radius - v / rate < v / rate * 0.45**4 / 100


def test_no_turns_of_a_vehicle_in_a_disk_better_the_circles():
    known = Simulated("DubinsDisk")
    radius = circle_radius(0.8, math.pi, 0.05)
    x = np.random.default_rng(0).uniform((-1, -1, -math.pi), (1, 1, math.pi), (4000, 3)).T

    def outwards(x):
        return x[0] * np.cos(x[2]) + x[1] * np.sin(x[2]) > 0.0

    def reach(x):
        sides = [
            np.hypot(x[0] - s * radius * np.sin(x[2]), x[1] + s * radius * np.cos(x[2]))
            for s in (1, -1)
        ]
        return np.minimum(*sides) + radius

    x = x[:, (np.hypot(x[0], x[1]) < 1.0) & outwards(x) & (reach(x) > 1.002)]
    # Each of 3^6 sequences of left, straight and right, of two periods each.
    rates = np.array(list(itertools.product((-math.pi, 0.0, math.pi), repeat=6))).T
    x = np.repeat(x[:, :40], rates.shape[1], axis=1)
    rates = np.tile(rates, 40)
    inside, turned = np.ones(x.shape[1], dtype=bool), np.zeros(x.shape[1], dtype=bool)
    for period in range(12):
        x = np.stack(known.step.step(tuple(x), (rates[period // 2],), ()))
        inside &= np.hypot(x[0], x[1]) <= 1.0
        turned |= inside & ~outwards(x)
    assert not turned.any()


def test_the_laws_of_a_vehicle_in_a_disk_reach_nearly_all_of_the_kernel():
    known = Simulated("DubinsDisk")
    x = np.random.default_rng(0).uniform((-1, -1, -math.pi), (1, 1, math.pi), (8000, 3)).T
    x = x[:, np.hypot(x[0], x[1]) <= 1.0]
    outwards = x[0] * np.cos(x[2]) + x[1] * np.sin(x[2])
    kept, fits = np.zeros(x.shape[1], dtype=bool), np.zeros(x.shape[1], dtype=bool)
    for law in known.laws.laws:
        smallest, after = known.stays(law, x, round(known.laws.horizon / 0.05))
        kept |= (smallest >= 0) & (known.terminal(law, after) >= -1e-9)
        fits |= known.terminal(law, x) >= 0
    kernel = fits | (outwards <= 0)
    assert not (kept & ~kernel & (outwards > 0.05)).any()
    assert kept[kernel].mean() > 0.99


def stopping_distance(v, lead, force):
    """Return the distance that full braking with drag takes from v to the speed of the lead."""
    drag = lambda s: 0.1 + 5.0 * s + 0.25 * s**2  # noqa: E731
    return quad(lambda s: (s - lead) * 1650.0 / (force + drag(s)), lead, v)[0]


def test_braking_reaches_the_exact_kernel_of_a_car():
    known = Simulated("ACCGap")
    (law,) = known.laws.laws
    force = known.problem.input_bounds[0][1]
    speeds = np.linspace(21.0, 50.0, 15)
    exact = np.array([stopping_distance(v, 20.0, force) for v in speeds])
    for excess, kept in ((1e-3, True), (-1e-3, False)):
        x = np.stack([speeds, 10.0 + exact * (1 + excess)])
        smallest, _ = known.stays(law, x, 1200)
        assert ((smallest >= 0.0) == kept).all()


def test_numbers_that_allow_no_backup_leave_no_terminal_set():
    for name, options in (
        ("DubinsDisk", {"input_bounds": (-0.1, 0.1)}),
        ("DubinsDisk", {"dt": 2.0}),
        ("ACCGap", {"input_bounds": (0.0, 4000.0)}),
        ("ACCGap", {"plant": {"v_f": 0.01}, "model": {"v_f": 0.01}}),
    ):
        known = Simulated(name, **options)
        x = np.random.default_rng(0).uniform(-1, 1, (known.problem.plant.n, 500)) * 20
        for law in known.laws.laws:
            assert (known.terminal(law, x) < 0.0).all()


@pytest.mark.parametrize(
    "name",
    [
        *("DubinsDisk", "ACC", "ACCGap", "QuadrotorAltitude"),
        *(pytest.param(name, marks=pytest.mark.oracle) for name in ("Pendulum", "QuadrotorLimits")),
    ],
)
def test_every_stated_backup_fits_its_model(name):
    problem = problem_of(f"safe_envs/{name}-v0")
    stated = backup_of(problem)
    found = with_terminal_sets(problem, problem.model)
    assert found.horizon == stated.horizon
    for law in found.laws:
        symbols = set().union(*(e.free_symbols for e in (*law.law, law.terminal)))
        assert symbols <= set(problem.plant.states)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"plant": {"f_2": -1.0}}, "fall with the speed"),
        ({"plant": {"f_1": -1.0}, "model": {"f_1": -1.0}}, "fall with the speed"),
        ({"plant": {"M": -5.0}}, "positive mass"),
        ({"plant": {"f_0": -5000.0}}, "above the lower bound"),
        ({"input_bounds": (-4000.0, -100.0)}, "upper bound"),
    ],
)
def test_what_the_proof_of_braking_takes_is_checked(options, said):
    for name in ("ACC", "ACCGap"):
        problem = problem_of(f"safe_envs/{name}-v0", noise=0.0, **options)
        with pytest.raises(ConfigurationError, match=said):
            backup_of(problem)


def test_a_drag_that_a_period_changes_too_much_leaves_no_terminal_set():
    sizes = {"f_2": 40.0}
    known = Simulated("ACCGap", dt=0.5, plant=sizes, model=sizes)
    (law,) = known.laws.laws
    x = np.array([[50.0, 21.0], [400.0, 400.0]])
    assert (known.terminal(law, x) < 0.0).tolist() == [True, False]
