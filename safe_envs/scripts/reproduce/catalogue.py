"""All artefacts, in the order of the thesis."""

from __future__ import annotations

from safe_envs.scripts.reproduce.chapter_3 import dubins_disk, dubins_obstacle, quadrotor
from safe_envs.scripts.reproduce.chapter_4 import (
    cruise,
    cruise_effort,
    dubins_noise,
    dubins_points,
    martingale,
)
from safe_envs.scripts.reproduce.chapter_5 import cubic, cubic_paths, pendulum
from safe_envs.scripts.reproduce.chapter_6 import bayesian_cruise, bayesian_cubic
from safe_envs.scripts.reproduce.framework.artefact import Artefact

ARTEFACTS: tuple[Artefact, ...] = (
    *dubins_disk.ARTEFACTS,
    *dubins_obstacle.ARTEFACTS,
    *quadrotor.ARTEFACTS,
    *martingale.ARTEFACTS,
    *cruise_effort.ARTEFACTS,
    *cruise.ARTEFACTS,
    *dubins_noise.ARTEFACTS,
    *dubins_points.ARTEFACTS,
    *pendulum.ARTEFACTS,
    *cubic.ARTEFACTS,
    *cubic_paths.ARTEFACTS,
    *bayesian_cubic.ARTEFACTS,
    *bayesian_cruise.ARTEFACTS,
)
