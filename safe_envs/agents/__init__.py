"""Policies with Stable-Baselines3's `predict`, and the evaluation of policies and filters.

Nothing here imports torch or Stable-Baselines3 before an agent is trained, or a policy of that
library is loaded.
"""

from typing import Any

from safe_envs.agents.evaluation.evaluate import Evaluation, evaluate, run_evaluation
from safe_envs.agents.evaluation.refinement import Refinement, refine
from safe_envs.agents.evaluation.spec import EvaluationSpec, RunSettings
from safe_envs.agents.evaluation.statistics import (
    mcnemar_p,
    paired_difference_interval,
    rate_interval,
    wilson_interval,
)
from safe_envs.agents.policies.base import Policy
from safe_envs.agents.policies.clf import CLFController
from safe_envs.agents.policies.nominal import NominalController, RandomPolicy, ZeroController
from safe_envs.agents.policies.registry import POLICIES, make_policy
from safe_envs.registry import make_problem

__all__ = [
    "POLICIES",
    "CLFController",
    "Evaluation",
    "EvaluationSpec",
    "FilteredReplayBuffer",  # pyright: ignore[reportUnsupportedDunderAll]
    "NominalController",
    "Policy",
    "RandomPolicy",
    "Refinement",
    "RunSettings",
    "ZeroController",
    "evaluate",
    "make_policy",
    "make_problem",
    "make_sb3_env",  # pyright: ignore[reportUnsupportedDunderAll]
    "mcnemar_p",
    "paired_difference_interval",
    "rate_interval",
    "refine",
    "run_evaluation",
    "wilson_interval",
]


def __getattr__(name: str) -> Any:
    if name == "make_sb3_env":
        from safe_envs.agents.training.vec_env import make_sb3_env

        return make_sb3_env
    if name == "FilteredReplayBuffer":
        from safe_envs.agents.training.replay_buffer import FilteredReplayBuffer

        return FilteredReplayBuffer
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


if __name__ == "agents":  # imported through the link at the top level of a checkout
    from safe_envs.checkout_links import redirect

    redirect(__name__)
