"""Trained policies as data, numbers and JSON in a folder, so that nobody needs to run a stranger's
pickle."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from safe_envs.agents.policies.base import DESCRIPTION, TENSORS, saved_policy_files
from safe_envs.agents.policies.fixed_batch import BlockPolicy
from safe_envs.agents.policies.sb3 import require_spaces
from safe_envs.atomic_io import write_atomically
from safe_envs.bounded_reading import MOST_BYTES_OF_TEXT, read_bytes
from safe_envs.envs.env import action_box, observation_box
from safe_envs.errors import ConfigurationError, nearest, shortened, shown
from safe_envs.problem.problem import SafetyProblem

_FORMAT = 2
_PACKAGES = ("safe-envs", "numpy", "stable-baselines3", "torch", "safetensors")

_ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "identity": lambda x: x,
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
    "leaky_relu": lambda x: np.where(x < 0.0, 0.01 * x, x),
    "elu": lambda x: np.where(x < 0.0, np.expm1(np.minimum(x, 0.0)), x),
    "silu": lambda x: 0.5 * x * (1.0 + np.tanh(0.5 * x)),
}
_OUTPUTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "clip": lambda x: np.clip(x, -1.0, 1.0),
}

# What json and safetensors raise on damaged files, and Python on JSON of another shape.
_DAMAGED = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    SafetensorError,
    TypeError,
    ValueError,
)

_MOST_BYTES = 100_000_000
"""Of the numbers of a policy; they are in memory a few times."""


@dataclass(frozen=True)
class Normalization:
    """What Stable-Baselines3's VecNormalize does to observations.

    Attributes:
        mean: k numbers, subtracted.
        var: k numbers; their roots divide then.
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
        """What a VecNormalize does by now; None if that is nothing."""
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
        """Normalise (B, k)."""
        return np.clip(
            (observations - np.array(self.mean)) / np.sqrt(np.array(self.var) + self.epsilon),
            -self.clip,
            self.clip,
        )


class NetworkPolicy(BlockPolicy):
    """The deterministic actor of a trained policy, in NumPy alone.

    It computes in double precision: what it rounds to single precision hardly depends on the
    machine then.

    Args:
        weights: of each layer, (outputs, inputs) of the layer.
        biases: of each layer, (outputs,).
        activation: after every layer but the last, by its name in `policy.json`.
        output: after the last one, "tanh" or "clip".
        normalization: before the first one, if any.
        boxes: physical boxes of the training and of the env, each (m, 2), where they differ.

    Raises:
        ConfigurationError: an activation is unknown, or a number is not finite.
    """

    def __init__(
        self,
        weights: Sequence[np.ndarray],
        biases: Sequence[np.ndarray],
        activation: str,
        output: str,
        normalization: Normalization | None = None,
        boxes: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        super().__init__(weights[0].shape[1])
        for what, name, allowed in (
            ("activation", activation, _ACTIVATIONS),
            ("output", output, _OUTPUTS),
        ):
            if name not in allowed:
                raise ConfigurationError(f"{what} = {shown(name)}; {nearest(str(name), allowed)}")
        _require_finite([*weights, *biases])
        self._layers = [
            (np.ascontiguousarray(w.T, dtype=float), b.astype(float))
            for w, b in zip(weights, biases, strict=True)
        ]
        self._activation, self._output = _ACTIVATIONS[activation], _OUTPUTS[output]
        self._normalization = normalization
        self._boxes = boxes

    def act(self, block: np.ndarray) -> np.ndarray:
        """Evaluate the layers; see `BlockPolicy.act`."""
        x = block.astype(float)
        if self._normalization is not None:
            x = self._normalization(x)
        for weights, bias in self._layers[:-1]:
            x = self._activation(x @ weights + bias)
        weights, bias = self._layers[-1]
        actions = self._output(x @ weights + bias)
        if self._boxes is not None:
            actions = _in_another_box(actions, *self._boxes)
        return actions.astype(np.float32)


def save_policy(
    model: Any, folder: str | Path, problem: SafetyProblem, normalization: Any = None
) -> None:
    """Write the deterministic actor of a model of Stable-Baselines3 as `policy.safetensors` and
    `policy.json`.

    Args:
        model: PPO, A2C, SAC, TD3 or DDPG with MlpPolicy.
        folder: where to; it is made if need be.
        problem: in which the policy was trained.
        normalization: the VecNormalize that it was trained with; by default that of the model's
            env, if it has one.

    Raises:
        ConfigurationError: the policy is of another kind or of another problem, its numbers are not
            finite, or the folder cannot be written.
    """
    from safe_envs.agents.policies.sb3_actor import actor_of

    require_spaces(
        f"the policy of {type(model).__name__}",
        model.policy,
        observation_box(problem),
        action_box(problem),
    )
    weights, biases, activation = actor_of(model.policy)
    _require_finite([*weights, *biases])
    scaling = Normalization.of(
        model.get_vec_normalize_env() if normalization is None else normalization
    )
    description = {
        "format": _FORMAT,
        "algorithm": type(model).__name__,
        "layers": [weights[0].shape[1], *(len(w) for w in weights)],
        "activation": activation,
        "output": "tanh" if model.policy.squash_output else "clip",
        "normalization": None if scaling is None else asdict(scaling),
        "problem": _identity(problem),
        "dt": problem.dt,
        "box": _box(problem).tolist(),
        "versions": {package: version(package) for package in _PACKAGES},
    }
    arrays = {**_numbered("weight", weights), **_numbered("bias", biases)}
    # The numbers name their description, so that their checksum is one of the whole policy.
    content = save_tensors(arrays, metadata={"description": _checksum(description)})
    text = json.dumps(
        {**description, "sha256": hashlib.sha256(content).hexdigest()}, indent=2, allow_nan=False
    )
    _write(Path(folder), {TENSORS: content, DESCRIPTION: f"{text}\n".encode()})


def load_policy(folder: str | Path, problem: SafetyProblem) -> NetworkPolicy:
    """Read what `save_policy` wrote; no code is run.

    An action stands for an input in physical units. In an env with another box than that of the
    training the policy gives the same inputs, and where that box does not hold one, the nearest one
    that it holds.

    Args:
        folder: or one of the two files in it.
        problem: in which the policy is to act.

    Raises:
        ConfigurationError: there is no such policy, it is damaged, altered or of an unknown format,
            or belongs to another problem.
    """
    files = saved_policy_files(Path(folder))
    if len(files) < 2:
        raise ConfigurationError(
            f"{shortened(folder)} is no folder; name one with {TENSORS} and {DESCRIPTION}, as"
            " `safe-envs train` writes them"
        )
    content, text = _read(files[0], _MOST_BYTES), _read(files[1], MOST_BYTES_OF_TEXT)
    try:
        description = json.loads(text)
        _require_format(files[1], description)
        _require_untouched(files, content, description)
        _require_problem(files[1].parent, description["problem"], problem)
        return _policy(load_tensors(content), description, problem)
    except _DAMAGED as error:
        if isinstance(error, ConfigurationError):
            raise
        raise ConfigurationError(
            f"the policy in {files[0].parent} cannot be read ({type(error).__name__}:"
            f" {shortened(error)}); it is damaged or altered: copy it again"
        ) from error


def _policy(
    arrays: Mapping[str, np.ndarray], description: Mapping[str, Any], problem: SafetyProblem
) -> NetworkPolicy:
    sizes, scaling = description["layers"], description["normalization"]
    depth, ends = len(sizes) - 1, [len(problem.features), len(problem.inputs)]
    shapes = {f"weight_{k}": (sizes[k + 1], sizes[k]) for k in range(depth)} | {
        f"bias_{k}": (sizes[k + 1],) for k in range(depth)
    }
    fits = [sizes[0], sizes[-1]] == ends and {name: a.shape for name, a in arrays.items()} == shapes
    if not fits or any(a.dtype != np.float32 for a in arrays.values()):
        raise ValueError("the tensors are not those of the layers")
    normalization = None if scaling is None else Normalization.from_json(scaling)
    if normalization is not None and {len(normalization.mean), len(normalization.var)} != {
        sizes[0]
    }:
        raise ValueError("the normalisation is not that of the observations")
    trained, given = np.array(description["box"], dtype=float), _box(problem)
    if (
        trained.shape != given.shape
        or not np.isfinite(trained).all()
        or (trained[:, 0] >= trained[:, 1]).any()
    ):
        raise ValueError("the box is not one of the inputs")
    boxes = None if np.array_equal(trained, given) else (trained, given)
    weights, biases = ([arrays[f"{name}_{k}"] for k in range(depth)] for name in ("weight", "bias"))
    return NetworkPolicy(
        weights, biases, description["activation"], description["output"], normalization, boxes
    )


def _numbered(name: str, arrays: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    return {f"{name}_{k}": np.ascontiguousarray(a) for k, a in enumerate(arrays)}


def _require_finite(arrays: Sequence[np.ndarray]) -> None:
    if not all(np.isfinite(a).all() for a in arrays):
        raise ConfigurationError(
            "the weights of the policy are not all finite: its training diverged; train with a"
            " smaller learning rate"
        )


def _box(problem: SafetyProblem) -> np.ndarray:
    """The physical box of a problem's inputs, (m, 2)."""
    return np.array(problem.box, dtype=float)


def _in_another_box(actions: np.ndarray, trained: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Actions (B, m) that stand for the same inputs in the given box as others in the trained one,
    or for the nearest ones."""
    (center, half), (new_center, new_half) = (
        (box.mean(axis=1), 0.5 * np.ptp(box, axis=1)) for box in (trained, given)
    )
    return np.clip((center + half * actions - new_center) / new_half, -1.0, 1.0)


def _identity(problem: SafetyProblem) -> dict[str, Any]:
    """What must be the same where a policy is used: dt and parameters may differ, to see what comes
    of that, and the box."""
    box = observation_box(problem)
    return {
        "system": problem.name,
        "states": [s.symbol.name for s in problem.states],
        "features": [f.name for f in problem.features],
        "inputs": [i.symbol.name for i in problem.inputs],
        "observation": {
            "shape": list(box.shape),
            "low": _strict(box.low),
            "high": _strict(box.high),
        },
    }


def _strict(bounds: np.ndarray) -> list[float | str]:
    """Bounds as strict JSON has them: it knows no infinity, which an unbounded state has, and gets
    a text for it."""
    return [bound if math.isfinite(bound) else str(bound) for bound in bounds.tolist()]


def _require_problem(folder: Path, trained: Mapping[str, Any], problem: SafetyProblem) -> None:
    for name, wanted in _identity(problem).items():
        if trained[name] != wanted:
            raise ConfigurationError(
                f"the policy in {folder} was trained for another problem, with {name}"
                f" {trained[name]}; that of {problem.name} is {wanted}. Use the env and the"
                " arguments that it was trained with, or train for this one"
            )


def _require_format(path: Path, description: Mapping[str, Any]) -> None:
    if description["format"] != _FORMAT:
        raise ConfigurationError(
            f"{path} has the format {shown(description['format'])}; this version reads {_FORMAT}:"
            " use the one that wrote it, or train again"
        )


def _require_untouched(
    files: Sequence[Path], content: bytes, description: Mapping[str, Any]
) -> None:
    if hashlib.sha256(content).hexdigest() != description["sha256"]:
        raise ConfigurationError(
            f"{files[0]} was altered or truncated, or belongs to another {DESCRIPTION}; train or"
            " copy both again"
        )
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    if header["__metadata__"]["description"] != _checksum(
        {k: v for k, v in description.items() if k != "sha256"}
    ):
        raise ConfigurationError(
            f"{files[1]} was altered: its content does not match its checksum; train or copy it"
            " again"
        )


def _checksum(description: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


def _read(path: Path, most: int) -> bytes:
    try:
        return read_bytes(path, most)
    except OSError as error:
        if isinstance(error, FileNotFoundError) and (path.parent / "config.json").exists():
            raise ConfigurationError(
                f"the training in {path.parent} is not finished: go on with it by `safe-envs train"
                f" ... --resume`, or give the best policy so far, {path.parent / 'best'}, which is"
                " there after the first evaluation"
            ) from error
        raise ConfigurationError(
            f"{path} cannot be read: {error.strerror}; give a folder with {TENSORS} and"
            f" {DESCRIPTION}, as `safe-envs train` writes it"
        ) from error


def _write(folder: Path, contents: Mapping[str, bytes]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"the folder {folder} cannot be made: {error.strerror}; give another one"
        ) from error
    for name, content in contents.items():
        write_atomically(folder / name, lambda part, content=content: part.write_bytes(content))
