"""Models of Stable-Baselines3 as policies: objects, and the archives that they are saved in."""

from __future__ import annotations

import inspect
import io
import pickle
import sys
import zipfile
import zlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.agents.policies.base import Spaces, arrays_of, require_spaces
from safe_envs.agents.policies.names import statistics_file
from safe_envs.agents.policies.network_policy import in_another_box
from safe_envs.agents.policies.trained import (
    Normalizer,
    TrainedPolicy,
    TrainingLayers,
    missing_statistics,
    saw_normalized,
    training_layers,
)
from safe_envs.errors import ConfigurationError, shortened
from safe_envs.files import open_archive, open_regular, read_bytes
from safe_envs.filters.learning.data import Signature
from safe_envs.problem.problem import SafetyProblem

_MOST_BYTES = 100_000_000


def is_model(given: Any) -> bool:
    """Return whether an object is an algorithm or a policy of Stable-Baselines3."""
    # Where nobody has imported it there is none.
    places = (("base_class", "BaseAlgorithm"), ("policies", "BasePolicy"))
    known = [(sys.modules.get(f"stable_baselines3.common.{file}"), name) for file, name in places]
    return any(module and isinstance(given, getattr(module, name)) for module, name in known)


def policy_of_model(model: Any, problem: SafetyProblem, spaces: Spaces) -> TrainedPolicy:
    """Return a model as a policy that sees and acts through what lay around it in training.

    In an env of this project an action stands for an input in physical units: where the bounds of
    the inputs differ from those of the training, the policy gives the nearest input.

    Args:
        model: an algorithm, or the policy of one.
        problem: which it is to act in.
        spaces: of observations and actions there.

    Raises:
        ConfigurationError: It was trained on another env, or behind something that cannot be taken
            up; see `training_layers`.
    """
    layers = training_layers(model, problem.name)
    require_same_env(type(model).__name__, layers, problem, spaces)
    act, trained = list(layers.act), layers.problem
    if trained is not None and trained.input_bounds != problem.input_bounds:
        boxes = (
            np.array(trained.input_bounds, dtype=float),
            np.array(problem.input_bounds, dtype=float),
        )
        act.append(partial(in_another_box, boxes=boxes))
    return TrainedPolicy(model, spaces[0], layers.observe, act)


def require_same_env(
    name: str, layers: TrainingLayers, problem: SafetyProblem, spaces: Spaces
) -> None:
    """Raise ConfigurationError where it is known that a model was trained on another env.

    Args:
        name: of the model's class.
        layers: of its training.
        problem: which it is to act in, or the model of a third-party env, whose id it has as name.
        spaces: of observations and actions there.
    """
    require_spaces(f"the policy of {name}", layers.spaces, spaces)
    if layers.problem is not None:
        difference = Signature.of(layers.problem).difference(problem)
    else:
        wanted, spec, difference = gym.registry.get(problem.name), layers.spec, ""
        if wanted is not None and spec is not None and wanted.entry_point != spec.entry_point:
            difference = f"{spec.id}, and not {problem.name}"
    if difference:
        raise ConfigurationError(
            f"the policy of {name} was trained on another env: {difference}. Train it on this one;"
            " to play its network here all the same give model.policy"
        )


def policy_of_archive(path: Path, spaces: Spaces) -> TrainedPolicy:
    """Return the policy in a .zip of Stable-Baselines3, with the statistics of its training.

    Only the policy is built, not the algorithm around it, so that there is no need to know which
    one saved it. The file does not say for which inputs its actions stand: that is left to the
    input bounds of the env. The statistics of VecNormalize are those of a file next to it, see
    `statistics_file`.

    Args:
        path: of the file. Loading it runs code that it contains, and so does loading its
            statistics: trust their source.
        spaces: of observations and actions of the env that it is to act in.

    Raises:
        ConfigurationError: The file is no archive of Stable-Baselines3, or its spaces are not those
            of the env; or its statistics are missing, several or damaged.
    """
    network, saved = _load(path)
    require_spaces(f"the policy {path}", (network.observation_space, network.action_space), spaces)
    normalizer = _normalizer(path, saved, network.observation_space)
    return TrainedPolicy(network, spaces[0], [] if normalizer is None else [normalizer])


def require_archive(path: Path) -> None:
    """Raise ConfigurationError unless a file looks like a policy of Stable-Baselines3.

    Nothing in it is run.
    """
    if not _is_archive(path):
        raise ConfigurationError(
            f"{path} is not a policy that Stable-Baselines3 saved, or damaged, or larger than"
            f" {_MOST_BYTES / 1e6:g} MB; give a .zip of `model.save(...)`, or a folder of"
            " `safe-envs train`"
        )


def _is_archive(path: Path) -> bool:
    """Whether a file has the parts of a policy, none of which is large when it is unpacked."""
    try:
        with (
            open_regular(path, _MOST_BYTES) as stream,
            open_archive(stream, _MOST_BYTES) as archive,
        ):
            if not {"data", "policy.pth"} <= set(archive.namelist()):
                return False
            # What torch saves is an archive itself.
            inner = [
                content
                for name in archive.namelist()
                if (content := archive.read(name)).startswith(b"PK")
            ]
            for content in inner:
                open_archive(io.BytesIO(content), _MOST_BYTES).close()
            return True
    except (
        OSError,
        EOFError,
        NotImplementedError,
        RuntimeError,
        ValueError,
        zipfile.BadZipFile,
        zlib.error,
    ):
        return False


def _load(path: Path) -> tuple[Any, Mapping[str, Any]]:
    """Return the network of an archive, and the attributes of its model."""
    require_archive(path)
    import torch
    from stable_baselines3.common.save_util import load_from_zip_file

    # Small networks run many times slower on several threads of a busy machine.
    torch.set_num_threads(1)
    try:
        data, parameters, _ = load_from_zip_file(path, device="cpu")
        saved: Mapping[str, Any] = data or {}
        kind = saved["policy_class"]
        options = dict(saved.get("policy_kwargs") or {})
        if saved.get("use_sde"):
            options["use_sde"] = True
        # Those without a gradient, such as ARS, have no learning rate.
        if "lr_schedule" in inspect.signature(kind).parameters:
            options["lr_schedule"] = _no_learning
        network = kind(saved["observation_space"], saved["action_space"], **options)
        network.load_state_dict(parameters["policy"])
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            f"{path} needs the module {error.name}, which is not there; install it, or work where"
            " it can be imported"
        ) from error
    except Exception as error:  # What a pickle may raise has no limits.
        raise ConfigurationError(
            f"{path} cannot be read as a policy ({type(error).__name__}:"
            f" {shortened(str(error).partition(chr(10))[0])}); it is damaged, or another version of"
            " Stable-Baselines3 saved it"
        ) from error
    network.set_training_mode(False)
    return network.to("cpu"), saved


def _no_learning(_: float) -> float:
    return 0.0


def _normalizer(path: Path, saved: Mapping[str, Any], space: gym.Space[Any]) -> Normalizer | None:
    """Return the normalisation of the observations of an archive; None without one."""
    normalized = saw_normalized(saved)
    if normalized is False:  # What lies next to it is of another training.
        return None
    file = statistics_file(path)
    if file is None:
        if normalized:
            raise missing_statistics(str(path))
        return None
    try:
        wrapper = pickle.loads(read_bytes(file, _MOST_BYTES))
        if not wrapper.norm_obs:
            return None
        if wrapper.observation_space != space:
            raise ValueError(f"it is of observations of {wrapper.observation_space}")
        found = Normalizer(wrapper)
        if not all(np.isfinite(array).all() for array in arrays_of(found(space.sample()))):
            raise ValueError("its numbers are not finite")
    except Exception as error:  # What a pickle may raise has no limits.
        raise ConfigurationError(
            f"{file} does not hold the statistics of the observations of {path}"
            f" ({type(error).__name__}: {shortened(error)}); save those of its training there, by"
            " model.get_vec_normalize_env().save(...)"
        ) from error
    return found


_ACTIVATIONS = {
    "Tanh()": "tanh",
    "ReLU()": "relu",
    "LeakyReLU(negative_slope=0.01)": "leaky_relu",
    "ELU(alpha=1.0)": "elu",
    "SiLU()": "silu",
}


def actor_of(network: Any) -> tuple[list[np.ndarray], list[np.ndarray], str]:
    """Return the layers of the deterministic action, before it is squashed or clipped.

    With gSDE the noise alone is of another kind: the deterministic action of PPO and A2C is the
    same. SAC bounds it by another layer then, and is refused.

    Args:
        network: MlpPolicy of PPO, A2C, SAC, TD3 or DDPG.

    Returns:
        Weights (outputs, inputs) and biases (outputs,) of each layer as float32, and the name of
        the activation between them.

    Raises:
        ConfigurationError: the policy is of another kind.
    """
    from stable_baselines3.common.torch_layers import FlattenExtractor
    from torch import nn

    extractor, modules = _modules(network)
    if type(extractor) is not FlattenExtractor:
        raise _refused(f"it has the features extractor {type(extractor).__name__}")
    linear, between = modules[::2], modules[1::2]
    for module in linear:
        if type(module) is not nn.Linear or module.bias is None:
            raise _refused(
                f"it has a {type(module).__name__} where a fully connected layer with a bias is"
                " allowed"
            )
    names = {_activation(module) for module in between}
    if len(names) > 1:
        raise _refused(f"it has several activations: {', '.join(sorted(names))}")
    weights, biases = (
        [getattr(module, name).detach().cpu().float().numpy() for module in linear]
        for name in ("weight", "bias")
    )
    return weights, biases, names.pop() if names else "identity"


def _modules(network: Any) -> tuple[Any, list[Any]]:
    """Return the features extractor, and layers and activations by turns."""
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.sac.policies import SACPolicy
    from stable_baselines3.td3.policies import TD3Policy

    # Not isinstance: what a class derived from these does differently is unknown.
    if type(network) is ActorCriticPolicy:
        return network.pi_features_extractor, [
            *network.mlp_extractor.policy_net,
            network.action_net,
        ]
    if type(network) is SACPolicy:
        return network.actor.features_extractor, [*network.actor.latent_pi, network.actor.mu]
    if type(network) is TD3Policy:
        # The last module is the tanh that squashes the output.
        return network.actor.features_extractor, list(network.actor.mu)[:-1]
    raise _refused(f"it is a {type(network).__name__}")


def _activation(module: Any) -> str:
    name = (
        _ACTIVATIONS.get(repr(module))
        if type(module).__module__ == "torch.nn.modules.activation"
        else None
    )
    if name is None:
        raise _refused(f"its activation is {module}; allowed: {', '.join(_ACTIVATIONS)}")
    return name


def _refused(reason: str) -> ConfigurationError:
    return ConfigurationError(
        f"this policy cannot be saved as data: {reason}. Train the MlpPolicy of PPO, A2C, SAC, TD3"
        " or DDPG, without gSDE for SAC, or keep the .zip of `model.save(...)`, with"
        " vecnormalize.pkl next to it if it has one; that needs --trust"
    )
