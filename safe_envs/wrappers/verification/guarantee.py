"""The guarantee of a filter: the one entry for bounds on its probability of safety."""

from __future__ import annotations

from collections.abc import Sequence

from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions import BayesianSCBF, Condition, LearnedCondition
from safe_envs.wrappers.verification.chain_guarantee import ChainGuarantee
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.posterior_guarantee import posterior_guarantee
from safe_envs.wrappers.verification.results import Guarantee


def guarantee_of(
    problem: SafetyProblem, conditions: Sequence[Condition], knowledge: str = "model"
) -> Guarantee:
    """Estimate the bound of conditions, deterministically and without a look at more than it needs.

    For a known system it is a `ChainGuarantee`, with the suprema and the shortfall of `verify` with
    its defaults. For a robust condition on an identified one it is a `PosteriorGuarantee`.

    Args:
        problem: whose barriers, input bounds, ranges and system are taken.
        conditions: one for each barrier.
        knowledge: what they know, "model" or "plant".

    Raises:
        ConfigurationError: the conditions are learned and not robust over a posterior, the data
            contradict what the posterior takes for granted, or no state of C was found.
        RelativeDegreeError: a condition does not suit a barrier.
    """
    if any(isinstance(c, BayesianSCBF) and c.simultaneous is not None for c in conditions):
        return posterior_guarantee(problem, conditions)
    if any(isinstance(c, LearnedCondition) for c in conditions):
        raise ConfigurationError(
            "it rests on something learned; for bayesian-scbf:simultaneous=P a bound is estimated"
            " over the posterior"
        )
    return ChainGuarantee(Formulas(problem, conditions, knowledge))
