"""Policies by name, by place and by file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from safe_envs.agents.policies.base import Policy, Spaces
from safe_envs.agents.policies.best import BestPolicy
from safe_envs.agents.policies.clf import CLFController
from safe_envs.agents.policies.custom import as_policy
from safe_envs.agents.policies.names import (
    POLICIES,
    POLICY_FILE,
    is_place,
    require_policy,
    saved_policy_file,
)
from safe_envs.agents.policies.nominal import NominalController, RandomPolicy, ZeroController
from safe_envs.agents.policies.sb3 import policy_of_archive, require_archive
from safe_envs.agents.policies.third_party import ModelPolicy
from safe_envs.envs.env import action_box, observation_box
from safe_envs.errors import ConfigurationError
from safe_envs.object_import import load_object
from safe_envs.plugins import POLICIES as POLICY_PLUGINS
from safe_envs.plugins import load_plugin, plugin_names
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import FilterSpec

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
