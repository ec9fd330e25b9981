"""Hyperparameters of Stable-Baselines3's algorithms for each env, in the RL Zoo's format and by its
names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, shortened, shown
from safe_envs.number_text import real

ALGORITHMS = ("ppo", "a2c", "sac", "td3")

_LINEAR = "lin_"
_SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf")


def hyperparameters(algorithm: str, env_id: str) -> dict[str, Any]:
    """What `hyperparams/ALGORITHM.yml` says of an env, under `default` where it does not name it.

    Args:
        algorithm: one of `ALGORITHMS`.
        env_id: full id.

    Raises:
        ConfigurationError: the algorithm is unknown.
    """
    import yaml

    if algorithm not in ALGORITHMS:
        raise ConfigurationError(f"--algo {shortened(algorithm)}: {nearest(algorithm, ALGORITHMS)}")
    table = yaml.safe_load(
        files("safe_envs.agents.training").joinpath("hyperparams", f"{algorithm}.yml").read_text()
    )
    return dict(table.get(env_id, table["default"]))


def scheduled(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with the Zoo's texts such as lin_3e-4 as functions of the part of the training
    that is left."""
    return {
        k: _linear(k, v) if k in _SCHEDULED and isinstance(v, str) else v
        for k, v in settings.items()
    }


def _linear(name: str, text: str) -> Callable[[float], float]:
    try:
        if not text.startswith(_LINEAR):
            raise ValueError
        first = real(text.removeprefix(_LINEAR))
    except ValueError as error:
        raise ConfigurationError(
            f"{name} = {shown(text)}; give a number, or {_LINEAR}NUMBER for one that falls to 0"
        ) from error
    # Whole rollouts may lead beyond the end of the training, where less than nothing is left.
    return lambda left: max(left, 0.0) * first
