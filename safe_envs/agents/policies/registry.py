"""Policies by name, by place and by file."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.agents.policies.base import Policy, Spaces, require_spaces, rows_of, shapes_of
from safe_envs.agents.policies.best import BestPolicy
from safe_envs.agents.policies.names import (
    POLICIES,
    POLICY_FILE,
    is_place,
    require_policy,
    saved_policy_file,
)
from safe_envs.agents.policies.nominal import (
    CLFController,
    NominalController,
    RandomPolicy,
    ZeroController,
)
from safe_envs.agents.policies.sb3 import (
    is_model,
    policy_of_archive,
    policy_of_model,
    require_archive,
)
from safe_envs.agents.policies.trained import TrainedPolicy
from safe_envs.envs.spaces import action_box, center_and_half_width, observation_box
from safe_envs.errors import ConfigurationError, InvalidInputError, SafeEnvsError, shortened
from safe_envs.plugins import POLICIES as POLICY_PLUGINS
from safe_envs.plugins import load_object, load_plugin, plugin_names
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.external_env import FilterSpec


class FunctionPolicy(Policy):
    """A function of a batch of observations as a policy.

    Args:
        function: maps observations (B, k), in double precision, to actions (B, m) in [-1, 1]; with
            one input (B,) will do too. Observations that are no vectors come as they are, each
            array with the batch in front. The action of a row may depend on that row only.
        space: of one observation.
        inputs: m.
    """

    def __init__(self, function: Callable[[Any], Any], space: gym.Space[Any], inputs: int) -> None:
        self._function, self._space, self._m = function, space, inputs
        self.name = policy_name(function)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Call the function; see `Policy.predict`.

        Raises:
            InvalidInputError: The function fails, or returns anything but (B, m) finite numbers.
        """
        rows, size, is_batch = rows_of(observation, self._space)
        if isinstance(self._space, gym.spaces.Box) and len(self._space.shape) == 1:
            rows = rows.astype(np.float64)
        try:
            actions = np.asarray(self._function(rows), dtype=np.float64)
        except SafeEnvsError:
            raise
        except Exception as error:
            raise InvalidInputError(
                f"the policy {self.name} failed on observations {shapes_of(rows)}"
                f" ({type(error).__name__}: {shortened(error)}); it is called with a batch"
            ) from error
        if self._m == 1 and actions.shape == (size,):
            actions = actions[:, None]
        if actions.shape != (size, self._m) or not np.isfinite(actions).all():
            reason = (
                f"returned actions of shape {actions.shape}"
                if actions.shape != (size, self._m)
                else "returned actions that are not finite"
            )
            raise InvalidInputError(
                f"the policy {self.name} {reason} for {size} observations; return finite"
                f" numbers in [-1, 1] of shape ({size}, {self._m}), a row for each observation"
            )
        return (actions if is_batch else actions[0]), state


def as_policy(given: Any, problem: SafetyProblem, spaces: Spaces | None = None) -> Any:
    """Return an object with `predict` for a policy from outside this project.

    What is known of its training is checked: a model of Stable-Baselines3 sees and acts through
    what lay around it there, see `policy_of_model`, and an object that says by
    `observation_space` and `action_space` what it is for has to be for this env.

    Args:
        given: an object with `predict`; a class that makes one, of the problem if it has a
            parameter without a default or called `problem`; a function that does so, without
            parameters or whose only one is called `problem`; or a function of a batch of
            observations, see `FunctionPolicy`.
        problem: which the policy is to act in.
        spaces: of observations and actions; by default those of the problem's env.

    Raises:
        ConfigurationError: It is none of these, the class cannot be called with the problem, or
            the policy is for another env.
    """
    spaces = spaces or (observation_box(problem), action_box(problem))
    made = _made(given, problem)
    if is_model(made):
        return policy_of_model(made, problem, spaces)
    if callable(getattr(made, "predict", None)):
        known = [getattr(made, f"{kind}_space", None) for kind in ("observation", "action")]
        # What does not say it takes what there is.
        said = [a if isinstance(a, gym.Space) else b for a, b in zip(known, spaces, strict=True)]
        require_spaces(f"the policy {policy_name(made)}", (said[0], said[1]), spaces)
        return made
    if callable(made):
        return FunctionPolicy(made, spaces[0], gym.spaces.flatdim(spaces[1]))
    raise ConfigurationError(
        f"a {type(made).__name__} is no policy; give an object with predict(observation, state,"
        " episode_start, deterministic), a class or function(problem) that takes the SafetyProblem"
        " and makes one, or a function of a batch of observations (B, k) that returns actions"
        " (B, m)"
    )


def _made(given: Any, problem: SafetyProblem) -> Any:
    """Return what a class or a function makes; anything else as it is."""
    if not inspect.isclass(given) and not inspect.isfunction(given):
        return given
    try:
        parameters = list(inspect.signature(given).parameters.values())
    except ValueError:  # of some classes that are not written in Python
        parameters = [inspect.Parameter("problem", inspect.Parameter.POSITIONAL_ONLY)]
    if inspect.isfunction(given) and [p.name for p in parameters] not in ([], ["problem"]):
        return given
    make: Any = given
    by_name = any(p.name == "problem" and p.kind is not p.POSITIONAL_ONLY for p in parameters)
    takes_problem = by_name or any(map(_is_needed, parameters))
    try:
        if by_name:
            return make(problem=problem)
        return make(problem) if takes_problem else make()
    except SafeEnvsError:
        raise
    except Exception as error:
        raise ConfigurationError(
            f"the policy {given.__name__} cannot be made"
            f"{f' with the problem {problem.name}' if takes_problem else ''}"
            f" ({type(error).__name__}: {shortened(error)}); a class, and a function whose"
            " only parameter is called problem, takes the SafetyProblem, or nothing"
        ) from error


def _is_needed(parameter: inspect.Parameter) -> bool:
    """Return whether a parameter has no default, or stands for any arguments."""
    return parameter.default is parameter.empty and parameter.kind is not parameter.VAR_KEYWORD


def policy_name(given: Any) -> str:
    """Return how results call a policy that is an object: its function's or its class's name."""
    if isinstance(given, FunctionPolicy | TrainedPolicy):
        return given.name
    return str(getattr(given, "__name__", type(given).__name__)).strip("<>")


class ModelPolicy(Policy):
    """A policy for the model's problem, from the env's observations to the env's actions.

    Args:
        policy: for the model's problem.
        filter_spec: how a filter sees the env.
        problem: the model as a problem.
        spaces: of the env's observations and actions.
    """

    def __init__(
        self, policy: Policy, filter_spec: FilterSpec, problem: SafetyProblem, spaces: Spaces
    ) -> None:
        self._policy, self._filter_spec = policy, filter_spec
        self._observations, self._actions = spaces
        self.deterministic = policy.deterministic
        self._center, self._half = (np.array(part) for part in center_and_half_width(problem))

    def begin(self, episodes: range, seed: int) -> None:
        """See `Policy.begin`."""
        self._policy.begin(episodes, seed)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Choose actions of the env; see `Policy.predict`."""
        rows, size, is_batch = rows_of(observation, self._observations)
        x = self._filter_spec.state(rows, (size,))
        actions, state = self._policy.predict(x, state, episode_start, deterministic)
        space: Any = self._actions
        inputs = self._filter_spec.actions(self._center + self._half * actions)
        found = np.clip(inputs, space.low, space.high).astype(space.dtype)
        return (found if is_batch else found[0]), state


_NAMED: dict[str, Any] = {
    "nominal": NominalController,
    "clf": CLFController,
    "zero": ZeroController,
    "random": RandomPolicy,
    "best": BestPolicy,
}


def make_policy(
    given: Any,
    problem: SafetyProblem,
    trust: bool = False,
    spaces: Spaces | None = None,
    filter_spec: FilterSpec | None = None,
) -> Any:
    """Return a named policy, one from a Python file, one that was trained, or one for an object.

    Args:
        given: one of `POLICIES`; a name that an installed package declares in the entry-point group
            `safe_envs.policies`; FILE.py:NAME or MODULE:NAME of what `as_policy` takes, which runs
            that code; the folder where `safe-envs train` or
            `safe_envs.agents.policies.network.save_policy` put a policy, or one of the two files of
            the policy in it; the path of a .zip of Stable-Baselines3; or what `as_policy` takes.
        problem: which the policy is to act in.
        trust: load a .zip too, which runs code that it contains.
        spaces: of observations and actions, which a policy that was trained or is a function is to
            fit; by default those of the problem's env.
        filter_spec: how filters see the third-party env whose model the problem is, if it is one.
            The built-in policies see the model's state there.

    Returns:
        A `Policy`, or another object with its `predict`.

    Raises:
        ConfigurationError: There is neither such a name nor such a file, the file does not fit the
            problem, or it is a .zip that is not trusted.
    """
    if not isinstance(given, str):
        return as_policy(given, problem, spaces)
    name = given
    if filter_spec is not None and spaces is not None:
        _require_third_party(name, problem.name, filter_spec)
        if name in _NAMED:
            return ModelPolicy(_NAMED[name](problem), filter_spec, problem, spaces)
    if name in _NAMED:
        return _NAMED[name](problem)
    if name in plugin_names(POLICY_PLUGINS):
        return as_policy(load_plugin(POLICY_PLUGINS, name), problem, spaces)
    if is_place(name):
        return as_policy(load_object(name), problem, spaces)
    if saved_policy_file(Path(name)) is not None:
        from safe_envs.agents.policies.network import load_policy

        return load_policy(name, problem)
    require_policy(name)
    return _make_of_archive(
        Path(name), spaces or (observation_box(problem), action_box(problem)), trust
    )


def _require_third_party(name: str, env_id: str, filter_spec: FilterSpec) -> None:
    """Raise ConfigurationError for the name of a policy that a third-party env cannot have."""
    if name == "best":
        raise ConfigurationError(
            f"the policy best needs the step of the env, and {env_id} is a third-party env, of"
            " which only a model is known; give --policy nominal, zero, random or a .zip"
        )
    if name == "nominal" and filter_spec.nominal is None:
        raise ConfigurationError(
            "the filter spec has no nominal controller; give it one, or --policy zero, random or a"
            " .zip"
        )
    if name not in POLICIES and saved_policy_file(Path(name)) is not None:
        raise ConfigurationError(
            f"{name} holds a policy for envs of this project; give a .zip of Stable-Baselines3 for"
            f" {env_id}"
        )


def _make_of_archive(path: Path, spaces: Spaces, trust: bool) -> Policy:
    require_archive(path)
    if not trust:
        raise ConfigurationError(
            f"loading {path} runs code that it contains; if you trust its source, pass --trust (in"
            f" Python: trust=True), or give a folder of `safe-envs train`, whose {POLICY_FILE}"
            " holds no code"
        )
    return policy_of_archive(path, spaces)
