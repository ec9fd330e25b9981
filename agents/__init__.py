"""Who acts, and how well: policies with Stable-Baselines3's `predict`, and the evaluation of filters.

Nothing here imports torch or Stable-Baselines3 before a saved policy is loaded.
"""

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
    "mcnemar_p",
    "paired_difference_interval",
    "rate_interval",
    "refine",
    "wilson_interval",
]
