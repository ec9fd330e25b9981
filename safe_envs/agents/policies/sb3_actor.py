"""From the policies of Stable-Baselines3 to the layers of their deterministic actors."""

from __future__ import annotations

from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError

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
