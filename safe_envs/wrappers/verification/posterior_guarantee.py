"""The guarantee over a posterior: for every system that the data leave possible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.tables import tabulated
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions import Condition
from safe_envs.wrappers.safety_filter import SafetyFilter
from safe_envs.wrappers.verification import bounds
from safe_envs.wrappers.verification.assumptions import amount, kinked, reaches, violated_by
from safe_envs.wrappers.verification.posterior_proof import (
    decision_at,
    proved_numbers_of,
)
from safe_envs.wrappers.verification.results import RELATIVE, Extremum, Status
from safe_envs.wrappers.verification.safe_set import (
    draw_starts,
    in_workspace,
    region_of,
    sample,
    workspace_of,
)
from safe_envs.wrappers.verification.search import Region, Score, largest
from safe_envs.wrappers.verification.smoothness import Asked, roughness
from safe_envs.wrappers.verification.step_bias import rate_bias

if TYPE_CHECKING:
    from safe_envs.wrappers.learning.models.posterior import Posterior

_SAMPLES = 8192
_STARTS = 64


@dataclass(frozen=True)
class PosteriorGuarantee:
    """(1 - delta) (h_0 - (m + e) T)/c, a bound on P(safe on [0, T]) of a robust `BayesianSCBF`.

    With probability 1 - delta of the posterior, A h of the true system is at least -(m + e)
    wherever X is in C and in the workspace, and h/c less what that costs is then a lower bound
    (`safe_envs.wrappers.verification.bounds.stage_bound`). The posterior takes the prior, the
    features and constant Gaussian noise for granted. The judge proves c and m or, where it cannot,
    they are what a search found, which is an estimate from below; e, of first order in the length
    of the steps, is an estimate too. So the bound is proved, given the posterior, where both
    numbers are and e is 0.

    Attributes:
        delta: probability that the identification is outside its regions, delta_theta +
            delta_sigma.
        supremum: c, of h over C.
        shortfall: m, by how much the robust condition is violated where that is most, in the units
            of h per s.
        bias: e, by how much the length of the steps in the data may shift A h, in the units of h
            per s, at sampled states; see `safe_envs.wrappers.verification.step_bias.rate_bias`.
        remark: what weakens it, in words; may be empty.
        word: "proved" or "estimated".
        searched: which of supremum and shortfall a search found, below their true values; the
            others are proved.
    """

    delta: float
    supremum: float
    shortfall: float
    bias: float
    remark: str
    word: Status
    searched: tuple[str, ...]
    _barrier: Any
    _workspace: tuple[np.ndarray, np.ndarray]
    note: None = None

    def at(self, starts: np.ndarray, horizon: float) -> np.ndarray:
        """Return the estimate at starts; see `ChainGuarantee.at`."""
        h = self._barrier(np.asarray(starts, dtype=np.float64))[:, 0]
        return (1.0 - self.delta) * bounds.stage_bound(
            h, self.supremum, horizon, shortfall=self.shortfall + self.bias
        )

    def contradiction(
        self, reached: np.ndarray, violated: np.ndarray, actions: np.ndarray, slack: np.ndarray
    ) -> str:
        """Say what states contradict in c and m; see `ChainGuarantee.contradiction`."""
        h = self._barrier(reached[in_workspace(reached, self._workspace)])[:, 0]
        if (h > self.supremum * (1.0 + RELATIVE)).any():
            return reaches("h", h.max(), self._extremum("supremum"))
        inside = in_workspace(violated, self._workspace) & (self._barrier(violated)[:, 0] > 0.0)
        most = float(slack[inside].max(initial=0.0))
        exceeded = most > self.shortfall * (1.0 + RELATIVE)
        return violated_by(most, self._extremum("shortfall")) if exceeded else ""

    def _extremum(self, name: str) -> Extremum:
        value = getattr(self, name)
        return Extremum(value) if name in self.searched else Extremum(value, value)


def posterior_guarantee(
    problem: SafetyProblem, conditions: Sequence[Condition], seed: int = 0
) -> PosteriorGuarantee:
    """Estimate the bound of a robust filter over its posterior.

    Args:
        problem: whose barrier, input bounds, workspace and starts are taken; its plant and model
            do not matter.
        conditions: one, a `BayesianSCBF` with `simultaneous`.
        seed: of the search.

    Returns:
        The bound.

    Raises:
        ConfigurationError: there is another condition or more than one barrier, the data contradict
            what the posterior takes for granted, h is not twice differentiable, or C has no end in
            a workspace that has none, where neither c nor m is known.
    """
    credible = conditions[0].credible_set if len(conditions) == 1 else None
    if credible is None:
        raise ConfigurationError(
            "a bound over a posterior is for one barrier with bayesian-scbf:simultaneous=P"
        )
    posterior = credible.posterior
    _require_consistent(posterior)
    robust = SafetyFilter.for_problem(problem, conditions)
    expression = posterior.system.numeric(problem.barriers[0].expression)
    barrier = tabulated(problem.plant.states, [expression])
    row = robust.constraints[0]
    region = region_of(problem, posterior.system, [expression, *row.coefficient, row.offset])

    def level(x: np.ndarray) -> np.ndarray:
        return barrier(x)[:, 0]

    rest = np.mean(problem.box, axis=1)

    def shortfall_at(x: np.ndarray) -> np.ndarray:
        return np.where(level(x) >= 0.0, decision_at(robust, x, rest).slack[:, 0], -np.inf)

    _require_inside(level, region, problem, np.random.default_rng([seed, 0]))
    starts = draw_starts(problem, _STARTS)
    points = sample("C", level, region, _SAMPLES, np.random.default_rng([seed, 1])).points
    points = np.concatenate([points, starts[level(starts) >= 0.0]])
    _require_smooth(problem, expression, level, points, region, np.random.default_rng([seed, 4]))
    highest, _ = largest(level, points, region, np.random.default_rng([seed, 2]))
    missed, _ = largest(shortfall_at, points, region, np.random.default_rng([seed, 3]))
    missed = max(missed, 0.0)
    proved = proved_numbers_of(problem, robust, expression, (highest, missed))
    supremum, shortfall = Extremum(highest, proved.supremum), Extremum(missed, proved.shortfall)
    numbers = {"supremum": supremum, "shortfall": shortfall}
    bias = rate_bias(posterior, expression, np.array(problem.box), points)
    remarks = [f"no action meets the robust condition somewhere, {amount(shortfall)}"] * bool(
        missed
    )
    remarks += [
        f"steps of {posterior.dt:g} s in the data may shift the rate of h by up to {bias:.3g} at"
        " the sampled states"
    ] * (bias > 0.0)
    unproved = proved.reason or "the length of the steps in the data" * (bias > 0.0)
    remarks += [f"not proved: {unproved}"] * bool(unproved)
    word: Status = "estimated" if unproved else "proved"
    return PosteriorGuarantee(
        credible.miss_probability,
        supremum.value,
        shortfall.value,
        bias,
        "; ".join(remarks),
        word,
        tuple(name for name, n in numbers.items() if not n.is_proved),
        barrier,
        workspace_of(problem),
    )


def _require_smooth(
    problem: SafetyProblem,
    expression: sp.Expr,
    level: Score,
    points: np.ndarray,
    region: Region,
    rng: np.random.Generator,
) -> None:
    asked = Asked(problem.barriers[0].name, expression, only_poles=False)
    rough = kinked(asked.name, expression) or roughness(
        [asked], problem.plant.states, level, points, region, rng
    )
    if rough:
        raise ConfigurationError(rough)


def _require_consistent(posterior: Posterior) -> None:
    """Raise ConfigurationError where the data show a misfit or varying noise beyond chance.

    The regions of the weights and of sigma are for exact features and constant noise.
    """
    for state, misfit, varying in zip(
        posterior.features.states, posterior.misfit, posterior.variation, strict=True
    ):
        if misfit:
            raise ConfigurationError(
                f"the features miss {100 * misfit:.3g} % of the rate of {state}, beyond chance;"
                " raise the degree"
            )
        if varying:
            raise ConfigurationError(
                f"the variance of the noise of {state} varies by {100 * varying:.3g} %, beyond"
                " chance; a bound over the posterior is for constant noise"
            )


def _require_inside(
    level: Score, region: Region, problem: SafetyProblem, rng: np.random.Generator
) -> None:
    """Raise ConfigurationError where C reaches beyond ranges that were chosen for unbounded states.

    It may reach beyond the workspace, where episodes are at an end.
    """
    if (level(region.beyond(rng, *workspace_of(problem))) >= 0.0).any():
        raise ConfigurationError(
            "C reaches beyond the states that are searched, so that neither sup h nor the shortfall"
            " is known"
        )
