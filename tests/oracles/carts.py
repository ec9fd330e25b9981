"""Systems with backups whose kernels are known in closed form."""

from __future__ import annotations

import numpy as np
import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.backup import Backup, BackupLaw
from safe_envs.problem.builder import define_problem
from safe_envs.proofs.backup_filter import BackupFilter, BackupSettings

x, v, a = sp.symbols("x v a", real=True)
STRONGEST = 1.5
DT = 0.1

BRAKE = BackupLaw("brake", (sp.Float(-STRONGEST),), terminal=sp.Min(-v, 1 - x))
"""Under it v falls for ever, and x falls where v <= 0."""

PULL = BackupLaw("pull", (sp.Float(STRONGEST),), terminal=sp.Min(v, x + 1))


def cart(noise=0.0):
    """x'' = a, with noise in v."""
    return ControlAffineSDE(
        states=(x, v),
        inputs=(a,),
        drift=sp.Matrix([v, 0]),
        input_matrix=sp.Matrix([0, 1]),
        diffusion=sp.Matrix([0, sp.Float(noise)]),
    )


def backup(horizon=4.0, laws=(BRAKE,)):
    return Backup(laws, horizon)


def cart_filter(horizon=4.0, settings=None, dt=DT):
    return BackupFilter(
        cart(), 1 - x, backup(horizon), (-STRONGEST, STRONGEST), dt, settings=settings
    )


def cart_problem(noise=0.0, laws=(BRAKE,), barriers=1 - x, **options):
    return define_problem(
        cart(noise),
        barriers,
        **{
            "input_bounds": (-STRONGEST, STRONGEST),
            "start": [(-0.5, 0.0), (-0.5, 0.5)],
            "dt": DT,
            "horizon": 5.0,
            "name": "cart",
            "nominal": STRONGEST,
            "backup": backup(laws=laws),
            **options,
        },
    )


def highest(states, dt=DT, strongest=STRONGEST):
    """Largest x at control instants after this one under full braking, which is the smallest.

    x_k = x + k dt v - (k dt)^2 a/2 under the held input -a: exact, and so is a step of RK4.
    """
    k = np.arange(1, 200)[:, None] * dt
    return (states[:, 0] + k * states[:, 1] - strongest * k**2 / 2).max(axis=0)


def moved(states, inputs, dt=DT):
    """The states after one held period."""
    u = inputs[:, 0]
    return np.column_stack(
        [states[:, 0] + dt * states[:, 1] + dt**2 * u / 2, states[:, 1] + dt * u]
    )


def drawn(count, seed=0):
    """States about the kernel's edge, and proposed inputs."""
    rng = np.random.default_rng(seed)
    states = np.column_stack([rng.uniform(-2, 1, count), rng.uniform(-2, 3, count)])
    return states, rng.uniform(-STRONGEST, STRONGEST, (count, 1))


def settings(**given):
    return BackupSettings(**given)


y, w, b = sp.symbols("y w b", real=True)


def table(noise=0.0):
    """A cart that also moves along the wall: x'' = a, y'' = b."""
    return ControlAffineSDE(
        states=(x, v, y, w),
        inputs=(a, b),
        drift=sp.Matrix([v, 0, w, 0]),
        input_matrix=sp.Matrix([[0, 0], [1, 0], [0, 0], [0, 1]]),
        diffusion=sp.Matrix([0, sp.Float(noise), 0, 0]),
    )


STOP = BackupLaw(
    "stop",
    (sp.Float(-STRONGEST), sp.Float(-STRONGEST)),
    terminal=sp.Min(-v, 1 - x, -w, 4 - y),
)
"""It brakes in both directions."""


def table_problem(**options):
    return define_problem(
        table(),
        (1 - x, sp.Float(4) - y),
        **{
            "input_bounds": (-STRONGEST, STRONGEST),
            "start": [(-0.5, 0.0), (-0.5, 0.5), 0.0, (-0.5, 0.5)],
            "dt": DT,
            "horizon": 3.0,
            "name": "table",
            "nominal": [STRONGEST, 0.3],
            "backup": Backup((STOP,), 4.0),
            **options,
        },
    )
