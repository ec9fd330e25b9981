"""Who acts, and how well: policies with Stable-Baselines3's `predict`, and the evaluation of filters.

Nothing here imports torch or Stable-Baselines3 before an agent is trained, or a policy of that library is loaded.
"""

from typing import Any

from agents.clf import CLFController
from agents.evaluation import Evaluation, evaluate
from agents.nominal import NominalController, RandomPolicy, ZeroController
from agents.policy import POLICIES, Policy, make_policy
from agents.problems import load_problem
from agents.refinement import Refinement, refine
from agents.statistics import mcnemar_p, paired_difference_interval, rate_interval, wilson_interval

__all__ = [
    "POLICIES",
    "CLFController",
    "Evaluation",
    "NominalController",
    "Policy",
    "RandomPolicy",
    "Refinement",
    "ZeroController",
    "evaluate",
    "load_problem",
    "make_policy",
    "make_sb3_env",  # pyright: ignore[reportUnsupportedDunderAll]
    "mcnemar_p",
    "paired_difference_interval",
    "rate_interval",
    "refine",
    "wilson_interval",
]


def __getattr__(name: str) -> Any:
    if name == "make_sb3_env":
        from agents.sb3_env import make_sb3_env

        return make_sb3_env
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
