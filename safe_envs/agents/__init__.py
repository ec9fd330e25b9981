"""Policies with Stable-Baselines3's `predict`, and the evaluation of policies and filters.

What is named here is imported when it is first used: nothing imports torch or Stable-Baselines3
before an agent is trained, or a policy of that library is loaded.
"""

from typing import TYPE_CHECKING

from safe_envs.lazy_attributes import lazy_attributes

if TYPE_CHECKING:
    from safe_envs.agents.evaluation.evaluate import (
        Evaluation,
        Refinement,
        evaluate,
        refine,
        run_evaluation,
    )
    from safe_envs.agents.evaluation.spec import EvaluationSpec, RunSettings
    from safe_envs.agents.evaluation.statistics import (
        mcnemar_p,
        paired_difference_interval,
        rate_interval,
        wilson_interval,
    )
    from safe_envs.agents.policies.base import Policy
    from safe_envs.agents.policies.names import POLICIES
    from safe_envs.agents.policies.nominal import (
        CLFController,
        NominalController,
        RandomPolicy,
        ZeroController,
    )
    from safe_envs.agents.policies.registry import make_policy
    from safe_envs.agents.training.replay_buffer import FilteredReplayBuffer
    from safe_envs.agents.training.vec_env import make_sb3_env
    from safe_envs.registry import make_problem

__all__ = [
    "POLICIES",
    "CLFController",
    "Evaluation",
    "EvaluationSpec",
    "FilteredReplayBuffer",
    "NominalController",
    "Policy",
    "RandomPolicy",
    "Refinement",
    "RunSettings",
    "ZeroController",
    "evaluate",
    "make_policy",
    "make_problem",
    "make_sb3_env",
    "mcnemar_p",
    "paired_difference_interval",
    "rate_interval",
    "refine",
    "run_evaluation",
    "wilson_interval",
]

_MODULES = {
    "CLFController": "safe_envs.agents.policies.nominal",
    "Evaluation": "safe_envs.agents.evaluation.evaluate",
    "EvaluationSpec": "safe_envs.agents.evaluation.spec",
    "FilteredReplayBuffer": "safe_envs.agents.training.replay_buffer",
    "NominalController": "safe_envs.agents.policies.nominal",
    "POLICIES": "safe_envs.agents.policies.names",
    "Policy": "safe_envs.agents.policies.base",
    "RandomPolicy": "safe_envs.agents.policies.nominal",
    "Refinement": "safe_envs.agents.evaluation.evaluate",
    "RunSettings": "safe_envs.agents.evaluation.spec",
    "ZeroController": "safe_envs.agents.policies.nominal",
    "evaluate": "safe_envs.agents.evaluation.evaluate",
    "make_policy": "safe_envs.agents.policies.registry",
    "make_problem": "safe_envs.registry",
    "make_sb3_env": "safe_envs.agents.training.vec_env",
    "mcnemar_p": "safe_envs.agents.evaluation.statistics",
    "paired_difference_interval": "safe_envs.agents.evaluation.statistics",
    "rate_interval": "safe_envs.agents.evaluation.statistics",
    "refine": "safe_envs.agents.evaluation.evaluate",
    "run_evaluation": "safe_envs.agents.evaluation.evaluate",
    "wilson_interval": "safe_envs.agents.evaluation.statistics",
}

__getattr__, __dir__ = lazy_attributes(__name__, _MODULES, globals())

if __name__ == "agents":  # imported through the link at the top level of a checkout
    from safe_envs.checkout_links import redirect

    redirect(__name__)
