"""All artefacts, in the order of the thesis."""

from __future__ import annotations

from scripts.reproduce import (
    bayesian_cruise,
    bayesian_cubic,
    cruise,
    cubic,
    cubic_paths,
    dubins_learning,
    dubins_noise,
    martingale,
    pendulum,
    quadrotor,
)
from scripts.reproduce.artefact import Artefact

ARTEFACTS: tuple[Artefact, ...] = (
    *dubins_learning.ARTEFACTS,
    *quadrotor.ARTEFACTS,
    *martingale.ARTEFACTS,
    *cruise.ARTEFACTS,
    *dubins_noise.ARTEFACTS,
    *pendulum.ARTEFACTS,
    *cubic.ARTEFACTS,
    *cubic_paths.ARTEFACTS,
    *bayesian_cubic.ARTEFACTS,
    *bayesian_cruise.ARTEFACTS,
)
