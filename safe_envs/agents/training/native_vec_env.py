"""The attributes and methods of a native vector env, as Stable-Baselines3 asks for them per env."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices

from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers import (
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    StateEstimatorVectorWrapper,
)

_OF_ONE_ENV = {
    "observation_space": "single_observation_space",
    "action_space": "single_action_space",
}
_TUPLES_OF_ENVS = ("np_random", "np_random_seed")
_OF_THE_BATCH = ("reset", "step", "step_physical", "close")


class NativeVecEnv(VecEnv):
    """Base of a `VecEnv` over one native vector env, whose attributes all its envs share.

    Attributes:
        env: the native vector env, with or without a filter.

    Args:
        env: see above.
    """

    def __init__(
        self, env: SafeVectorEnv | SafetyFilterVectorWrapper | StateEstimatorVectorWrapper
    ) -> None:
        self.env = env
        self._native: SafeVectorEnv = env.unwrapped  # pyright: ignore[reportAttributeAccessIssue]
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        # Stable-Baselines3 lists the modes in which this env can be rendered, Gymnasium those with
        # which it could be made.
        self.metadata = {**env.metadata, "render_modes": self.metadata["render_modes"]}

    def close(self) -> None:
        """Close the native env."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return a picture of each env, None for each where the render mode is not "rgb_array"."""
        if self.render_mode != "rgb_array":
            warnings.warn(
                f"render_mode = {self.render_mode!r}, so that there are no images; make the env"
                " with 'rgb_array'",
                stacklevel=2,
            )
            return [None] * self.num_envs
        pictures: Any = self.env.render()
        return list(pictures)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the filter's wrapper or else of the native env, for each env.

        Each env gets its row of an array with the batch in front, like `state`, or of each array in
        a tuple or list of them, like `executed`, and its own spaces and generator; anything else
        is one object for all.

        Args:
            attr_name: name of the attribute.
            indices: of the envs to ask for.

        Raises:
            AttributeError: neither has it.
        """
        value = self._find(_OF_ONE_ENV.get(attr_name, attr_name))
        if attr_name in _TUPLES_OF_ENVS:
            return [value[i] for i in self._get_indices(indices)]
        return self._for_each(value, indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute for all envs, where it exists or else on the native env.

        Args:
            attr_name: name of the attribute.
            value: new value.
            indices: of all envs.

        Raises:
            AttributeError: it is a property that cannot be set.
            ConfigurationError: some envs are left out, which share their attributes with the
                others.
        """
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ConfigurationError(
                f"{attr_name!r} is shared by all {self.num_envs} envs; set it without indices, or"
                " make another VecEnv"
            )
        holder = next((layer for layer in self._layers() if attr_name in vars(layer)), self._native)
        setattr(holder, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the filter's wrapper or else of the native env, once for the batch.

        Its arguments have the batch in front, and its result is divided as by `get_attr`; from
        `render`, each env gets its picture.

        Args:
            method_name: name of the method.
            *method_args: its arguments.
            indices: of the envs to return a result for.
            **method_kwargs: its keyword arguments.

        Returns:
            The result for each env.

        Raises:
            AttributeError: neither has it.
            ConfigurationError: the method advances the envs, which only this class may do.
        """
        # Gymnasium has these two for single envs only.
        if method_name == "get_wrapper_attr":
            return self.get_attr(*method_args, indices=indices)
        if method_name == "has_wrapper_attr":
            return [self.has_attr(*method_args) for _ in self._get_indices(indices)]
        if method_name in _OF_THE_BATCH:
            raise ConfigurationError(
                f"env_method does not call {method_name!r}, which acts on all envs at once; call"
                " that of the VecEnv"
            )
        result = self._find(method_name)(*method_args, **method_kwargs)
        if method_name == "render" and result is not None:
            return [result[i] for i in self._get_indices(indices)]
        return self._for_each(result, indices)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Return whether each env is in such a wrapper.

        Args:
            wrapper_class: to look for; `SafetyFilterWrapper` includes that of vector envs.
            indices: of the envs to ask for.
        """
        wanted = (
            SafetyFilterVectorWrapper if wrapper_class is SafetyFilterWrapper else wrapper_class
        )
        wrapped = any(isinstance(layer, wanted) for layer in self._layers())
        return [wrapped for _ in self._get_indices(indices)]

    def _layers(self) -> Iterator[gym.vector.VectorEnv]:
        layer: gym.vector.VectorEnv = self.env
        while isinstance(layer, gym.vector.VectorWrapper):
            yield layer
            layer = layer.env
        yield layer

    def _find(self, name: str) -> Any:
        for layer in self._layers():
            try:
                return getattr(layer, name)
            except AttributeError:
                continue
        raise AttributeError(f"neither {self.env} nor what it wraps has an attribute {name!r}")

    def _for_each(self, value: Any, indices: VecEnvIndices) -> list[Any]:
        envs = self._get_indices(indices)
        if self._batched(value):
            return [value[i].copy() for i in envs]
        if isinstance(value, tuple | list) and value and all(map(self._batched, value)):
            kind = tuple if isinstance(value, tuple) else list
            return [kind([v[i].copy() if v.ndim > 1 else v.item(i) for v in value]) for i in envs]
        return [value for _ in envs]

    def _batched(self, value: Any) -> bool:
        return isinstance(value, np.ndarray) and value.shape[:1] == (self.num_envs,)
