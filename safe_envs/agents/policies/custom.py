"""Policies from outside this project: functions, classes, and any object with `predict`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.agents.policies.base import Spaces, StatelessPolicy
from safe_envs.envs.spaces import observation_names
from safe_envs.errors import ConfigurationError, InvalidInputError, SafeEnvsError, shortened
from safe_envs.problem.problem import SafetyProblem


class FunctionPolicy(StatelessPolicy):
    """A function of a batch of observations as a policy.

    Args:
        function: maps observations (B, k) to actions (B, m) in [-1, 1]; with one input (B,) will
            do too. The action of a row may depend on that row only.
        width: k.
        inputs: m.
    """

    def __init__(self, function: Callable[[np.ndarray], Any], width: int, inputs: int) -> None:
        super().__init__(width)
        self._function, self._m = function, inputs
        self.name = policy_name(function)

    def actions(self, given: np.ndarray) -> np.ndarray:
        """Call the function; see `StatelessPolicy.actions`.

        Raises:
            InvalidInputError: The function fails, or returns anything but (B, m) finite numbers.
        """
        rows = np.atleast_2d(given)
        try:
            actions = np.asarray(self._function(rows), dtype=np.float64)
        except SafeEnvsError:
            raise
        except Exception as error:
            raise InvalidInputError(
                f"the policy {self.name} failed on observations of shape {rows.shape}"
                f" ({type(error).__name__}: {shortened(error)}); it is called with a batch (B,"
                f" {self._width})"
            ) from error
        if self._m == 1 and actions.shape == (len(rows),):
            actions = actions[:, None]
        if actions.shape != (len(rows), self._m) or not np.isfinite(actions).all():
            reason = (
                f"returned actions of shape {actions.shape}"
                if actions.shape != (len(rows), self._m)
                else "returned actions that are not finite"
            )
            raise InvalidInputError(
                f"the policy {self.name} {reason} for {len(rows)} observations; return finite"
                f" numbers in [-1, 1] of shape ({len(rows)}, {self._m}), a row for each observation"
            )
        return actions.reshape(*given.shape[:-1], self._m)


def as_policy(given: Any, problem: SafetyProblem, spaces: Spaces | None = None) -> Any:
    """Return an object with `predict` for a policy from outside this project.

    Args:
        given: an object with `predict`; a class that takes the problem and makes one; a function
            that does so, whose only parameter is called `problem`; or a function of a batch of
            observations, see `FunctionPolicy`.
        problem: which the policy is to act in.
        spaces: of observations and actions; by default those of the problem's env.

    Raises:
        ConfigurationError: It is none of these, or the class cannot be called with the problem.
    """
    made: Any = given
    if inspect.isclass(given) or _is_factory(given):
        make: Any = given
        try:
            made = make(problem)
        except SafeEnvsError:
            raise
        except Exception as error:
            raise ConfigurationError(
                f"the policy {given.__name__} cannot be made with the problem {problem.name}"
                f" ({type(error).__name__}: {shortened(error)}); a class, and a function whose"
                " only parameter is called problem, takes the SafetyProblem"
            ) from error
    if callable(getattr(made, "predict", None)):
        return made
    if callable(made):
        if spaces is None:
            return FunctionPolicy(made, len(observation_names(problem)), len(problem.inputs))
        return FunctionPolicy(made, *map(gym.spaces.flatdim, spaces))
    raise ConfigurationError(
        f"a {type(made).__name__} is no policy; give an object with predict(observation, state,"
        " episode_start, deterministic), a class or function(problem) that takes the SafetyProblem"
        " and makes one, or a function of a batch of observations (B, k) that returns actions"
        " (B, m)"
    )


def _is_factory(given: Any) -> bool:
    """Return whether a function takes a problem, and not a batch of observations."""
    return inspect.isfunction(given) and list(inspect.signature(given).parameters) == ["problem"]


def policy_name(given: Any) -> str:
    """Return how results call a policy that is an object: its function's or its class's name."""
    if isinstance(given, FunctionPolicy):
        return given.name
    return str(getattr(given, "__name__", type(given).__name__)).strip("<>")
