"""Trained policies as networks: what they compute."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs.agents.policies.actions_kernel import action_in_another_box, clip_to_bound
from safe_envs.agents.policies.base import CHOOSE, BlockPolicy
from safe_envs.engine.formulas import Source
from safe_envs.engine.slots import Data
from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.filters.learning.models.network import Network, network_source

_OUTPUTS = {"tanh": np.tanh, "clip": lambda x: np.clip(x, -1.0, 1.0)}
_COMPILED_OUTPUTS = {"tanh": "tanh({})", "clip": "clip_to_bound({}, 1.0)"}


@dataclass(frozen=True)
class Normalization:
    """What Stable-Baselines3's VecNormalize does to observations.

    Attributes:
        mean: k numbers, subtracted.
        var: k numbers, by whose roots is divided then.
        clip: bound of the result.
        epsilon: added to `var`.

    Raises:
        ConfigurationError: a number is not finite, or out of range.
    """

    mean: tuple[float, ...]
    var: tuple[float, ...]
    clip: float
    epsilon: float

    def __post_init__(self) -> None:
        numbers = np.array([*self.mean, *self.var, self.clip, self.epsilon], dtype=float)
        if (
            not np.isfinite(numbers).all()
            or min(self.var) + self.epsilon <= 0.0
            or self.clip <= 0.0
        ):
            raise ConfigurationError(
                "the normalisation of a policy needs finite numbers, var + epsilon above 0 and clip"
                " above 0"
            )

    @classmethod
    def of(cls, wrapper: Any) -> Normalization | None:
        """Return what a VecNormalize does now; None if that is nothing."""
        if wrapper is None or not wrapper.norm_obs:
            return None
        moments = wrapper.obs_rms
        return cls(
            tuple(moments.mean.tolist()),
            tuple(moments.var.tolist()),
            float(wrapper.clip_obs),
            float(wrapper.epsilon),
        )

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Normalization:
        """Read what `asdict` and JSON made of one."""
        mean, var = (tuple(map(float, data[name])) for name in ("mean", "var"))
        return cls(mean, var, float(data["clip"]), float(data["epsilon"]))

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Normalise observations (B, k)."""
        return np.clip(
            (observations - np.array(self.mean)) / np.sqrt(np.array(self.var) + self.epsilon),
            -self.clip,
            self.clip,
        )

    def code(self, name: str, data: Data) -> str:
        """Return the entries of the normalised observation as code.

        Args:
            name: of the observation, a tuple.
            data: receives the numbers.
        """
        roots, entries = np.sqrt(np.array(self.var) + self.epsilon), ""
        for i, (mean, root) in enumerate(zip(self.mean, roots.tolist(), strict=True)):
            place = data.add([mean, root, self.clip])
            share = f"({name}[{i}] - data[{place}]) / data[{place + 1}]"
            entries += f"clip_to_bound({share}, data[{place + 2}]), "
        return entries


class NetworkPolicy(BlockPolicy):
    """The deterministic actor of a trained policy, in NumPy alone.

    It computes in double precision: what it rounds to single precision hardly depends on the
    machine then.

    Args:
        network: from observations to actions before `output`.
        output: function after the last layer, "tanh" or "clip".
        normalization: before the first layer, if any.
        boxes: input bounds of the training and of the env, each (m, 2), where they differ.

    Raises:
        ConfigurationError: the output is unknown.
    """

    def __init__(
        self,
        network: Network,
        output: str,
        normalization: Normalization | None = None,
        boxes: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        super().__init__(len(network.input_mean))
        if output not in _OUTPUTS:
            raise ConfigurationError(f"output = {shown(output)}; {nearest(str(output), _OUTPUTS)}")
        self._network, self._output = network, output
        self._normalization, self._boxes = normalization, boxes

    def act(self, block: np.ndarray) -> np.ndarray:
        """Evaluate the network; see `BlockPolicy.act`."""
        x = block.astype(float)
        if self._normalization is not None:
            x = self._normalization(x)
        actions = _OUTPUTS[self._output](self._network.outputs(x))
        if self._boxes is not None:
            actions = in_another_box(actions, self._boxes)
        return actions.astype(np.float32)

    def source(self, data: Data) -> Source:
        """See `Policy.source`. A matrix product of NumPy rounds otherwise, by another order."""
        network = network_source(self._network, "policy_network", data)
        given, entries = "observation", ""
        if self._normalization is not None:
            given = f"({self._normalization.code(given, data)})"
        for j in range(len(self._network.output_mean)):
            action = _COMPILED_OUTPUTS[self._output].format(f"outputs[{j}]")
            if self._boxes is not None:
                place = data.add(part[j] for box in self._boxes for part in _middles(box))
                numbers = ", ".join(f"data[{place + i}]" for i in range(4))
                action = f"action_in_another_box({action}, {numbers})"
            entries += f"single({action}), "
        return network + Source(
            f"{CHOOSE}    outputs = policy_network({given}, data, work)\n    return ({entries})\n",
            (clip_to_bound, action_in_another_box),
        )


def in_another_box(actions: np.ndarray, boxes: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return actions that stand for the same or the nearest inputs in other input bounds.

    Args:
        actions: in [-1, 1], shape (B, m).
        boxes: input bounds of the training and of the env, each (m, 2).
    """
    (center, half), (new_center, new_half) = map(_middles, boxes)
    return np.clip((center + half * actions - new_center) / new_half, -1.0, 1.0)


def _middles(box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles and half the widths of input bounds (m, 2)."""
    return box.mean(axis=1), 0.5 * np.ptp(box, axis=1)
