"""Files of trained policies: a network as numbers and JSON, and no pickle."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.agents.policies.names import POLICY_FILE, saved_policy_file
from safe_envs.agents.policies.network_policy import NetworkPolicy, Normalization
from safe_envs.agents.policies.sb3 import require_same_env
from safe_envs.agents.policies.trained import Normalizer, training_layers
from safe_envs.envs.spaces import action_box, observation_box, observation_names
from safe_envs.errors import ConfigurationError, shortened
from safe_envs.filters.learning import data
from safe_envs.filters.learning.data import Signature
from safe_envs.filters.learning.models.network import Network
from safe_envs.problem.problem import SafetyProblem

KIND = "policy"
"""Kind of a file that holds a policy."""

_WRITER = "safe-envs train"


def save_policy(
    model: Any, folder: str | Path, problem: SafetyProblem, normalization: Any = None
) -> None:
    """Write the deterministic actor of a model of Stable-Baselines3 as `policy.npz`.

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
    from safe_envs.agents.policies.sb3 import actor_of

    scaling = _normalization_of(model, problem, normalization)
    weights, biases, activation = actor_of(model.policy)
    if not all(np.isfinite(a).all() for a in (*weights, *biases)):
        raise ConfigurationError(
            "the weights of the policy are not all finite: its training diverged; train with a"
            " smaller learning rate"
        )
    network = Network.unscaled(weights, biases, activation)
    details = {
        "algorithm": type(model).__name__,
        "activation": activation,
        "output": "tanh" if model.policy.squash_output else "clip",
        "normalization": None if scaling is None else asdict(scaling),
        **_spaces(problem),
        "box": _box(problem).tolist(),
    }
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"the folder {folder} cannot be made: {error.strerror}; give another one"
        ) from error
    data.save(
        folder / POLICY_FILE, KIND, Signature.of(problem), details, network.to_arrays("actor")
    )


def _normalization_of(model: Any, problem: SafetyProblem, given: Any) -> Normalization | None:
    """Return the normalisation of a model's observations, and check what it was trained on."""
    name = type(model).__name__
    layers = training_layers(model, problem.name, given)
    require_same_env(name, layers, problem, (observation_box(problem), action_box(problem)))
    if layers.problem is not None and layers.problem.input_bounds != problem.input_bounds:
        raise ConfigurationError(
            f"the policy of {name} was trained with the input bounds"
            f" {layers.problem.input_bounds}, and those of the problem are"
            f" {problem.input_bounds}; give the problem of its training"
        )
    scales = [each for each in layers.observe if isinstance(each, Normalizer)]
    if layers.act or len(layers.observe) > len(scales) or len(scales) > 1:
        raise ConfigurationError(
            f"the policy of {name} was trained behind wrappers that change observations or actions,"
            " which a file of a policy does not hold; evaluate the model itself"
        )
    return Normalization.of(scales[0]) if scales else None


def load_policy(path: str | Path, problem: SafetyProblem) -> NetworkPolicy:
    """Read what `save_policy` wrote; no code is run.

    An action stands for an input in physical units. In an env with other input bounds than those
    of the training the policy gives the same inputs, and where these bounds do not hold one, the
    nearest one that they hold. Parameters of plant and model, dt and the horizon may differ too.

    Args:
        path: of the file, or of its folder.
        problem: in which the policy is to act.

    Raises:
        ConfigurationError: there is no such policy, it is damaged, altered or of an unknown format,
            or belongs to another problem.
    """
    file = saved_policy_file(Path(path)) or Path(path)
    if not file.exists() and (file.parent / "policy.safetensors").exists():
        raise ConfigurationError(
            f"the policy in {shortened(file.parent)} was saved by an older version, in another"
            f" format; train it again by `{_WRITER}`"
        )
    if not file.exists() and (file.parent / "config.json").exists():
        raise ConfigurationError(
            f"the training in {file.parent} is not finished: go on with it by `{_WRITER}`"
            f" ... --resume, or give the best policy so far, {file.parent / 'best'}, which is"
            " there after the first evaluation"
        )
    content = data.load(file, _WRITER)
    if content.kind != KIND:
        raise ConfigurationError(f"{shortened(file)} holds {content.kind}, and no policy")
    try:
        _require_problem(file, content, problem)
        return _policy(content, problem)
    except ConfigurationError:
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ConfigurationError(
            f"the policy in {shortened(file)} is incomplete or altered ({type(error).__name__}:"
            f" {shortened(error)}); train or copy it again"
        ) from error


def _policy(content: data.Content, problem: SafetyProblem) -> NetworkPolicy:
    details, scaling = content.details, content.details["normalization"]
    network = Network.from_arrays(content.arrays, "actor", details["activation"])
    ends = (len(network.input_mean), len(network.output_mean))
    if ends != (len(observation_names(problem)), len(problem.inputs)):
        raise ValueError("the network is not one from observations to actions")
    normalization = None if scaling is None else Normalization.from_json(scaling)
    if normalization is not None and {len(normalization.mean), len(normalization.var)} != {ends[0]}:
        raise ValueError("the normalisation is not that of the observations")
    trained, given = np.array(details["box"], dtype=float), _box(problem)
    if (
        trained.shape != given.shape
        or not np.isfinite(trained).all()
        or (trained[:, 0] >= trained[:, 1]).any()
    ):
        raise ValueError("the input bounds are not those of the inputs")
    boxes = None if np.array_equal(trained, given) else (trained, given)
    return NetworkPolicy(network, details["output"], normalization, boxes)


def _box(problem: SafetyProblem) -> np.ndarray:
    """Return the physical bounds of a problem's inputs, (m, 2)."""
    return np.array(problem.input_bounds, dtype=float)


def _spaces(problem: SafetyProblem) -> dict[str, Any]:
    """Describe the observations that a policy takes, which its signature does not know."""
    box = observation_box(problem)
    # Strict JSON knows no infinity, which an unbounded state has.
    low, high = (
        [end if math.isfinite(end) else str(end) for end in ends.tolist()]
        for ends in (box.low, box.high)
    )
    return {
        "features": observation_names(problem),
        "observation": {"low": low, "high": high},
    }


def _require_problem(path: Path, content: data.Content, problem: SafetyProblem) -> None:
    difference = content.signature.difference(problem)
    for name, wanted in _spaces(problem).items():
        if not difference and content.details[name] != wanted:
            difference = f"its {name}: {content.details[name]}, that of {problem.name}: {wanted}"
    if difference:
        raise ConfigurationError(
            f"the policy in {path} was trained for another problem: {shortened(difference)}. Use"
            " the env and the arguments that it was trained with, or train for this one"
        )
