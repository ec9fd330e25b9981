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
from safe_envs.scripts.reproduce.chapter_6 import (
    car_drift,
    car_rates,
    cubic_drift,
    cubic_rates,
    learning_times,
    noise_posterior,
)
from safe_envs.scripts.reproduce.framework.artefact import Artefact
from safe_envs.scripts.reproduce.framework.thesis_data import chapter

_MODULES = (
    *(dubins_disk, dubins_obstacle, quadrotor),
    *(martingale, cruise_effort, cruise, dubins_noise, dubins_points),
    *(pendulum, cubic, cubic_paths),
    *(cubic_drift, noise_posterior, cubic_rates, car_drift, car_rates, learning_times),
)
_ORDER = [name for number in (3, 4, 5, 6) for name in chapter(number).artefacts]

ARTEFACTS: tuple[Artefact, ...] = tuple(
    sorted(
        (artefact for module in _MODULES for artefact in module.ARTEFACTS),
        key=lambda artefact: _ORDER.index(artefact.name),
    )
)
