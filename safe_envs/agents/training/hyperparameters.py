"""Hyperparameters of the algorithms for each env, in the format of the RL Zoo and by its names."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, require_whole, shortened, shown
from safe_envs.text import real

ALGORITHMS = ("ppo", "a2c", "sac", "td3", "ppo-lag", "sac-lag")

OFF_POLICY = ("sac", "td3", "sac-lag")

CONSTRAINED = ("ppo-lag", "sac-lag")
"""Algorithms with a limit on the cost of an episode, on which alone they differ from others."""

ACTIONS = ("executed", "proposed", "both")
"""Actions on which an off-policy algorithm may learn with a filter in the loop; see
`safe_envs.agents.training.replay_buffer`."""

_WHOLE = {
    "n_timesteps": 1,
    "n_envs": 1,
    "n_steps": 1,
    "n_epochs": 1,
    "batch_size": 1,
    "buffer_size": 1,
    "learning_starts": 0,
    "gradient_steps": -1,
    "train_freq": 1,
    "policy_delay": 1,
    "target_update_interval": 1,
    "stats_window_size": 1,
    "sde_sample_freq": -1,
}
"""Hyperparameters that are whole numbers, and the least that each may be."""

_SHARES = ("gamma", "gae_lambda", "tau", "cost_gamma", "cost_gae_lambda")
"""Those from 0 to 1."""

_FROM_ZERO = (
    "learning_rate",
    "ent_coef",
    "vf_coef",
    "noise_std",
    "target_policy_noise",
    "target_noise_clip",
)

_ABOVE_ZERO = ("clip_range", "clip_range_vf", "max_grad_norm", "target_kl")

_POLICY = "MlpPolicy"

_TORCH_NN = ("nn", "th.nn", "torch.nn")
"""How the RL Zoo writes the module of activations."""

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


def checked(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters that are in their ranges, with 1e5 as the whole number that it is.

    What is no number, such as a schedule or None, is left to the algorithm.

    Args:
        settings: by the Zoo's names.

    Raises:
        ConfigurationError: one is out of its range.
    """
    found = dict(settings)
    if found.get("policy", _POLICY) != _POLICY:
        raise ConfigurationError(
            f"policy = {shown(found['policy'])}; the observations of this project's envs are"
            f" vectors, for which there is {_POLICY}"
        )
    for name, least in _WHOLE.items():
        value = found.get(name)
        if value is None or isinstance(value, list | tuple):  # such as [1, episode] of train_freq
            continue
        if isinstance(value, str):
            raise ConfigurationError(f"{name} = {shown(value)}; give a number")
        if isinstance(value, float) and value.is_integer():
            value = found[name] = int(value)
        require_whole(name, value, least)
    ends = {**dict.fromkeys(_SHARES, (0.0, 1.0)), **dict.fromkeys(_FROM_ZERO, (0.0, math.inf))}
    ends |= dict.fromkeys(_ABOVE_ZERO, (math.ulp(0.0), math.inf))
    for name, (low, high) in ends.items():
        value: Any = found.get(name)
        number = isinstance(value, int | float)
        if number and (isinstance(value, bool) or not low <= value <= min(high, 1e300)):
            allowed = "from 0 to 1" if high == 1.0 else "from 0" if low == 0.0 else "above 0"
            raise ConfigurationError(f"{name} = {shown(value)}; give a number {allowed}")
    return found


def python_value(name: str, text: str) -> Any:
    """Return the value of a hyperparameter that the RL Zoo writes in Python, without running it.

    Args:
        name: of the hyperparameter.
        text: literals, dict(NAME=VALUE, ...), and classes of torch.nn such as nn.ReLU.

    Raises:
        ValueError: it holds anything else.
    """
    try:
        return _value_of(ast.parse(text.strip(), mode="eval").body)
    except (
        AttributeError,
        MemoryError,
        RecursionError,
        SyntaxError,
        TypeError,
        ValueError,
    ) as error:
        raise ValueError(
            f"{name} = {shown(text)} is none of the values in Python that are read; give YAML such"
            " as {net_arch: [64, 64]}, or dict(net_arch=[64, 64], activation_fn=nn.ReLU)"
        ) from error


def _value_of(node: ast.expr) -> Any:
    match node:
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=pairs):
            return {pair.arg or _refuse(): _value_of(pair.value) for pair in pairs}
        case ast.Dict(keys=keys, values=values):
            entries = zip(keys, values, strict=True)
            return {_value_of(key or _refuse()): _value_of(value) for key, value in entries}
        case ast.List(elts=parts):
            return [_value_of(part) for part in parts]
        case ast.Tuple(elts=parts):
            return tuple(_value_of(part) for part in parts)
        case ast.Attribute(value=module, attr=name) if ast.unparse(module) in _TORCH_NN:
            from torch import nn

            kind = getattr(nn, name)
            return kind if isinstance(kind, type) and issubclass(kind, nn.Module) else _refuse()
    return ast.literal_eval(node)


def _refuse() -> Any:
    raise ValueError


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
