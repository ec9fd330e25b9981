"""The guarantee of conditions, by the kind of what they know."""

from __future__ import annotations

from collections.abc import Sequence

from safe_envs.problem.actuators import require_direct
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions import Certified, Condition
from safe_envs.wrappers.verification.certificate_guarantee import (
    CertificateGuarantee,
    certificate_guarantee,
)
from safe_envs.wrappers.verification.chain_guarantee import ChainGuarantee
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.posterior_guarantee import (
    PosteriorGuarantee,
    posterior_guarantee,
)

Guarantee = ChainGuarantee | PosteriorGuarantee | CertificateGuarantee
"""The largest bound that is estimated for a filter: `at` starts, with a `note` where there is none,
a `remark` where it is weak, and the `contradiction` by states that were seen."""


def guarantee_of(
    problem: SafetyProblem,
    conditions: Sequence[Condition],
    knowledge: str = "model",
    seconds: float | None = None,
) -> Guarantee:
    """Estimate the bound of conditions, deterministically and with no more search than it needs.

    For a known system it is a `ChainGuarantee`, with what the judge proves of it. For a robust
    condition on an identified one it is a `PosteriorGuarantee`, and for that of a certificate a
    `CertificateGuarantee`.

    Args:
        problem: whose barriers, input bounds, ranges and system are taken.
        conditions: one for each barrier.
        knowledge: what they know, "model" or "plant".
        seconds: see `ChainGuarantee`.

    Returns:
        The bound, or why there is none.

    Raises:
        ConfigurationError: the conditions are learned and not robust over a posterior, the data
            contradict what the posterior takes for granted, or no state of C was found.
        RelativeDegreeError: a condition does not suit a barrier.
    """
    require_direct(problem, "bounds of a filter")
    if any(isinstance(c, Certified) for c in conditions):
        return certificate_guarantee(problem, conditions)
    if any(c.credible_set is not None for c in conditions):
        return posterior_guarantee(problem, conditions)
    return ChainGuarantee(Formulas(problem, conditions, knowledge), seconds=seconds)
