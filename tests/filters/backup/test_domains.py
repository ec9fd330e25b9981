"""From the domain of a system's backup no filtered step is infeasible, whatever is proposed."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.integrators import Integrator
from safe_envs.proofs.backup_filter import BackupFilter
from safe_envs.registry import make_problem

SYSTEMS = {
    "DubinsDisk": ({}, (-1, -1, -4), (1, 1, 4)),
    "ACCGap": ({"noise": 0.0}, (0, 10), (50, 200)),
    "ACC": ({"noise": 0.0}, (0, 0, 0), (50, 50, 300)),
    "Pendulum": ({"noise": 0.0}, (-0.5, -0.5), (0.5, 0.5)),
    "QuadrotorAltitude": ({}, (3, -6), (7, 6)),
    "QuadrotorLimits": (
        {},
        (-5, -5, 3, -5, -5, -6, -0.5, -0.5, -3, -6, -6, -3),
        (5, 5, 7, 5, 5, 6, 0.5, 0.5, 3, 6, 6, 3),
    ),
}


class Pressed:
    """A system behind its backup filter, and those that propose its inputs."""

    def __init__(self, name, size, seed):
        options, low, high = SYSTEMS[name]
        self.problem = make_problem(f"safe_envs/{name}-v0", **options)
        plant = self.problem.plant
        self.filter = BackupFilter.for_problem(self.problem, knowledge="plant")
        self.rng, self.size = np.random.default_rng(seed), size
        self.low, self.high = np.array(self.problem.input_bounds).T
        self._step = Integrator(plant, self.problem.dt, self.problem.substeps, "arrays")
        expressions = [b.expression for b in self.problem.barriers]
        self._barriers = compile_function(plant.states, expressions, "arrays")
        self.corners = np.array(list(itertools.product(*self.problem.input_bounds)))
        self.held = self.corners[self.rng.integers(len(self.corners), size=size)]
        self.start = np.empty((0, plant.n))
        while len(self.start) < size:
            x = self.rng.uniform(low, high, (size, plant.n))
            at_rest = np.broadcast_to(0.5 * (self.low + self.high), (size, plant.m))
            kept = self.filter.filter(x, at_rest).feasible & (self.barrier(x) >= 0.0)
            self.start = np.concatenate([self.start, x[kept]])[:size]

    def barrier(self, x):
        return stacked(self._barriers(*x.T), len(x)).min(axis=1)

    def moved(self, x, u):
        columns = (tuple(np.ascontiguousarray(part.T)) for part in (x, u))
        return np.stack(self._step.step(*columns, ()), axis=1)

    def random(self, x):
        return self.rng.uniform(self.low, self.high, (len(x), len(self.low)))

    def bang_bang(self, x):
        switched = self.rng.random((len(x), 1)) < 0.1
        drawn = self.corners[self.rng.integers(len(self.corners), size=len(x))]
        self.held = np.where(switched, drawn, self.held)
        return self.held

    def adversary(self, x):
        """Propose the extreme input that brings the system nearest to the edge in two periods."""
        worst, chosen = np.full(len(x), np.inf), np.empty((len(x), len(self.low)))
        for corner in self.corners:
            u = np.broadcast_to(corner, chosen.shape)
            h = self.barrier(self.moved(self.moved(x, u), u))
            chosen[h < worst] = corner
            worst = np.minimum(worst, h)
        return chosen

    def run(self, proposes, steps):
        """Return the numbers of infeasible and of unsafe steps."""
        x, infeasible, unsafe = self.start, 0, 0
        for _ in range(steps):
            found = self.filter.filter(x, proposes(x))
            infeasible += int((~found.feasible).sum())
            assert (found.action >= self.low).all()
            assert (found.action <= self.high).all()
            x = self.moved(x, found.action)
            unsafe += int((self.barrier(x) < 0.0).sum())
        return infeasible, unsafe


POLICIES = ("random", "bang_bang", "adversary")
QUICK = [("DubinsDisk", "adversary"), ("ACCGap", "bang_bang")]


@pytest.mark.parametrize(("name", "policy"), QUICK)
def test_no_step_is_infeasible_or_unsafe(name, policy):
    pressed = Pressed(name, 40, seed=0)
    assert pressed.run(getattr(pressed, policy), 20) == (0, 0)


@pytest.mark.oracle
@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", SYSTEMS)
def test_no_step_of_a_million_is_infeasible_or_unsafe(name, policy):
    pressed = Pressed(name, 4000, seed=1)
    assert pressed.run(getattr(pressed, policy), 250) == (0, 0)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[] if n == "DubinsDisk" else pytest.mark.oracle) for n in SYSTEMS],
)
def test_every_start_of_the_env_is_in_the_domain(name):
    pressed = Pressed(name, 10, seed=2)
    problem = pressed.problem
    x = problem.starts[problem.start].proposals(1000)
    x = x[pressed.barrier(x) >= 0.0]
    at_rest = np.broadcast_to(0.5 * (pressed.low + pressed.high), (len(x), problem.plant.m))
    kept = pressed.filter.filter(x, at_rest).feasible
    if name == "DubinsDisk":  # Starts near the edge, heading outwards, are lost for every law.
        r_dot = x[:, 0] * np.cos(x[:, 2]) + x[:, 1] * np.sin(x[:, 2])
        assert kept[r_dot < 0].mean() > 0.99
        assert kept.mean() > 0.8
    elif name == "Pendulum":  # So are those that fall towards the edge.
        assert kept.mean() > 0.8
    else:
        assert kept.all()
