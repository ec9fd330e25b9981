"""Who acts, and how well: policies with Stable-Baselines3's `predict`, and the evaluation of filters.

Nothing here imports torch or Stable-Baselines3 before a saved policy is loaded.
"""

from agents.evaluation import Evaluation, evaluate
from agents.nominal import NominalController, RandomPolicy, ZeroController
from agents.policy import POLICIES, Policy, make_policy
from agents.problems import load_problem
from agents.statistics import wilson_interval

__all__ = [
    "POLICIES",
    "Evaluation",
    "NominalController",
    "Policy",
    "RandomPolicy",
    "ZeroController",
    "evaluate",
    "load_problem",
    "make_policy",
    "wilson_interval",
]
