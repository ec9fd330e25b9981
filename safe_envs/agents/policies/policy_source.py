"""Policies as functions of compiled programs."""

from __future__ import annotations

from typing import Any

from safe_envs.agents.policies.base import Policy, not_compilable
from safe_envs.engine.formulas import Source
from safe_envs.engine.program import has_own_source
from safe_envs.engine.slots import Data
from safe_envs.envs.batch_kernel import scaled_action
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.problem.problem import SafetyProblem

_COMPUTING = ("predict", "begin", "actions", "act")
"""Methods of policies by which they compute, as far as they have them."""


def policy_source(policy: Any, problem: SafetyProblem, data: Data) -> Source:
    """Return the function `act` of `safe_envs.engine.slots`.

    Args:
        policy: a `Policy`, or another object with its `predict`, which has no such function.
        problem: which the policy acts in.
        data: receives its numbers.

    Raises:
        NotCompilableError: The policy is more than formulas of an observation.
    """
    own = isinstance(policy, Policy) and has_own_source(policy, *_COMPUTING)
    if not own:
        raise not_compilable(policy)
    chosen = policy.source(data)
    entries = ""
    for j, (center, half) in enumerate(zip(*center_and_half_width(problem), strict=True)):
        place = data.add([center, half])
        entries += f"scaled_action(actions[{j}], data[{place}], data[{place + 1}]), "
    return chosen + Source(
        "def act(observation, step, k0, k1, data, work):\n"
        "    actions = choose(observation, step, k0, k1, data, work)\n"
        f"    return ({entries})\n",
        (scaled_action,),
    )
