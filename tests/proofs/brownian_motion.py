"""Small systems of which more is known than any certificate can say."""

from __future__ import annotations

import numpy as np
import sympy as sp

from safe_envs.filters.certificates.certificate import Plant
from safe_envs.proofs.certify import Task

x = sp.Symbol("x", real=True)


def brownian(horizon, starts=(np.pi / 2,)):
    """Brownian motion in (0, pi), without any input."""
    plant = Plant(
        states=(x,),
        workspace=((sp.Integer(-1), sp.Integer(4)),),
        inputs=(),
        bounds=(),
        drift=(sp.Integer(0),),
        input_matrix=((),),
        diffusion=((sp.Integer(1),),),
        barriers=(x, sp.pi - x),
    )
    return Task(plant, horizon, np.array(starts)[:, None], (False,))


def survival(start, time):
    """The probability that Brownian motion stays in (0, pi), by its series of eigenfunctions."""
    k = np.arange(1, 200, 2)
    return float((4 / (np.pi * k) * np.sin(k * start) * np.exp(-(k**2) * time / 2)).sum())
