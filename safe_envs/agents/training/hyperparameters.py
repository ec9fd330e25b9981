"""Hyperparameters of the algorithms for each env, in the format of the RL Zoo and by its names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, shortened, shown
from safe_envs.number_text import real

ALGORITHMS = ("ppo", "a2c", "sac", "td3", "ppo-lag", "sac-lag")
OFF_POLICY = ("sac", "td3", "sac-lag")
CONSTRAINED = ("ppo-lag", "sac-lag")
"""Algorithms with a limit on the cost of an episode, on which alone they differ from others."""

ACTIONS = ("executed", "proposed", "both")
"""Actions on which an off-policy algorithm may learn with a filter in the loop; see
`safe_envs.agents.training.replay_buffer`."""

_LINEAR = "lin_"
_EXTENDS = "extends"
_SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf")


def hyperparameters(algorithm: str, env_id: str) -> dict[str, Any]:
    """Return the hyperparameters of an env in `hyperparams/ALGORITHM.yml`, or its defaults.

    A file that extends the one of another algorithm adds to what that has for the env.

    Args:
        algorithm: one of `ALGORITHMS`.
        env_id: full id.

    Raises:
        ConfigurationError: the algorithm is unknown.
    """
    if algorithm not in ALGORITHMS:
        raise ConfigurationError(f"--algo {shortened(algorithm)}: {nearest(algorithm, ALGORITHMS)}")
    table = _table(algorithm)
    own = table.get(env_id, table["default"])
    return {**(hyperparameters(table[_EXTENDS], env_id) if _EXTENDS in table else {}), **own}


def _table(algorithm: str) -> dict[str, Any]:
    import yaml

    return yaml.safe_load(
        files("safe_envs.agents.training").joinpath("hyperparams", f"{algorithm}.yml").read_text()
    )


def whole_batches(batch_size: int, rollout: int, asked_for: bool) -> int:
    """Return the largest size of minibatches up to a given one that divides a rollout.

    Args:
        batch_size: wanted, from 2.
        rollout: steps of all envs together.
        asked_for: whether a user chose the size, who is not to get another one.

    Raises:
        ConfigurationError: the size is no whole number from 2, or was asked for and does not divide
            the rollout.
    """
    if isinstance(batch_size, bool) or not isinstance(batch_size, int) or batch_size < 2:
        raise ConfigurationError(f"batch_size = {batch_size!r}; give a whole number from 2")
    fits = next(
        (size for size in range(min(batch_size, rollout), 1, -1) if rollout % size == 0), rollout
    )
    if asked_for and fits != batch_size:
        raise ConfigurationError(
            f"batch_size = {batch_size} does not divide the rollout of n_steps x num_envs ="
            f" {rollout} steps; give {fits}"
        )
    return fits


def scheduled(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings, with texts such as lin_3e-4 as functions of the remaining progress."""
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
    # Whole rollouts may exceed the training, which makes the remaining progress negative.
    return lambda left: max(left, 0.0) * first
