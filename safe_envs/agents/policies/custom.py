"""Policies from outside this project: functions, classes, and any object with `predict`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.agents.policies.base import Policy, Spaces, require_spaces
from safe_envs.agents.policies.observations import rows_of, shapes_of
from safe_envs.agents.policies.sb3 import is_model, policy_of_model
from safe_envs.agents.policies.trained import TrainedPolicy
from safe_envs.envs.spaces import action_box, observation_box
from safe_envs.errors import ConfigurationError, InvalidInputError, SafeEnvsError, shortened
from safe_envs.problem.problem import SafetyProblem


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
