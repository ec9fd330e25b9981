"""The bound of any filter, and that over a posterior: for every system that data leave possible."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import tabulated
from safe_envs.errors import ConfigurationError
from safe_envs.filters.conditions.base import Condition
from safe_envs.filters.conditions.certified import Certified
from safe_envs.filters.qp import FilterDecision
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs import guarantees
from safe_envs.proofs.guarantees import (
    RELATIVE,
    CertificateGuarantee,
    ChainGuarantee,
    Extremum,
    Status,
    amount,
    certificate_guarantee,
    kinked,
    reaches,
    violated_by,
)
from safe_envs.proofs.judge import Budget, Statement, exact_number, judge, supremum
from safe_envs.proofs.safe_set import (
    Asked,
    Formulas,
    Region,
    Score,
    draw_starts,
    in_workspace,
    largest,
    region_of,
    roughness,
    sample,
    workspace_of,
)

if TYPE_CHECKING:
    from safe_envs.filters.learning.models.posterior import Posterior


_BUDGET = Budget(boxes=300_000, seconds=60.0)
_RELATIVE, _SMALL = 1e-2, 1e-4


class PosteriorNumbers(NamedTuple):
    """The numbers of a bound over a posterior that the judge proves.

    Attributes:
        supremum: proved upper bound of c; infinite without one.
        shortfall: proved upper bound of m, in the units of h per s; infinite without one.
        reason: what is not proved, in words; empty where all is.
    """

    supremum: float
    shortfall: float
    reason: str


def decision_at(robust: SafetyFilter, x: np.ndarray, rest: np.ndarray) -> FilterDecision:
    """Return what a filter of one barrier makes of an input.

    Args:
        robust: the filter.
        x: states, shape (B, n).
        rest: the input, shape (m,).

    Raises:
        NumericalError: The condition has no finite value at a state.
    """
    found = robust.filter(x, np.broadcast_to(rest, (len(x), len(rest))))
    lost = np.isinf(found.slack[:, 0])
    if lost.any():
        raise robust.undefined("the constraint", x[lost.argmax()].tolist(), [0])
    return found


def proved_numbers_of(
    problem: SafetyProblem, robust: SafetyFilter, barrier: sp.Expr, found: tuple[float, float]
) -> PosteriorNumbers:
    """Prove upper bounds of c and m over the safe set within the workspace.

    The input of the filter at the middle of a box is a witness: where it misses the condition by
    at most m on the whole box, so does the filter, whose own input misses it by the least.

    Args:
        problem: whose workspace and input bounds are taken.
        robust: filter with the robust condition.
        barrier: h, with numbers for all parameters.
        found: c and m of a search.

    Returns:
        The numbers, or what is not proved.
    """
    row, inputs = robust.constraints[0], robust.model.inputs
    if row.uncertainty is None or row.terms is not None or row.change is not None:
        return PosteriorNumbers(
            math.inf, math.inf, "the robust condition has no interval form for the judge"
        )
    box = tuple((exact_number(v.low), exact_number(v.high)) for v in problem.states)
    vector: tuple[Any, ...] = (sp.Integer(1), *inputs)
    pairs = itertools.combinations_with_replacement(range(len(vector)), 2)
    spread: Any = sum(
        q * vector[i] * vector[j] * (1 if i == j else 2)
        for q, (i, j) in zip(row.uncertainty, pairs, strict=True)
    )
    rate: Any = sum(a * u for a, u in zip(row.coefficient, inputs, strict=True)) + row.offset
    numeric = robust.model.numeric
    missed = numeric(sp.sqrt(sp.Max(spread, 0)) - rate)
    low, high = np.array(problem.input_bounds).T
    rest = (low + high) / 2.0

    def witness(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            chosen = decision_at(robust, x, rest).action
        return np.clip(np.nan_to_num(chosen), low, high)

    region = Statement("C", problem.plant.states, box, sp.Integer(1), positive=(barrier,))
    smooth = judge(replace(region, name="h on C", smooth=(barrier,)), _BUDGET)
    c, m = found
    top = supremum(region, barrier, 1e-3 * c, _BUDGET)
    tolerance = max(_RELATIVE * m, _SMALL * c / problem.duration)
    lack = supremum(replace(region, witnesses=inputs, witness=witness), missed, tolerance, _BUDGET)
    reasons = [smooth.reason]
    reasons += [bound.reason for bound in (top, lack) if not math.isfinite(bound.upper)]
    return PosteriorNumbers(
        max(top.upper, 0.0), max(lack.upper, 0.0), next(filter(None, reasons), "")
    )


_SLOPE, _CURVE = 1e-6, 1e-3
"""Parts of its range by which a state is moved for first and second derivatives."""

_MOST_INPUTS = 81
_MOST_STATES = 1024


def rate_bias(posterior: Posterior, barrier: sp.Expr, box: np.ndarray, x: np.ndarray) -> float:
    """Return by how much A h of the identified system is off at most, to first order in the step.

    Along F = f + g u with held u the mean of a step of dt is F dt + dt^2/2 L F, with the generator
    L of the system, and its covariance is S dt + dt^2/2 (J S + S J'), with S = sigma sigma' and J
    the Jacobian of F. So the regression finds F + dt/2 L F in place of F and S + dt/2 (J S + S J')
    in place of S. It is 0 for data that were collected from a plant that is integrated by one step
    of Euler and Maruyama a period: there the mean of a step is F dt exactly.

    Args:
        posterior: of the system; its mean stands for the truth.
        barrier: h, an expression of the states with numbers for all parameters.
        box: (low, high) of each input, shape (m, 2).
        x: states of the safe set, shape (B, n).
    """
    if posterior.record.settings.get("substeps") == 1:
        return 0.0
    x = x[:: -(-len(x) // _MOST_STATES)]
    slope, curvature = _derivatives(posterior.features.states, barrier, x)
    spread = posterior.diffusion.matrix() * posterior.diffusion.matrix().T
    covariance = tabulated(posterior.features.states, list(spread))(x)
    covariance = covariance.reshape(len(x), *spread.shape)
    most = 0.0
    for u in itertools.islice(
        itertools.product(*[np.linspace(low, high, 3) for low, high in box]), _MOST_INPUTS
    ):
        rate, jacobian, curved = _rates(posterior, x, np.array(u), covariance)
        moved = np.einsum("bij,bj->bi", jacobian, rate) + curved
        widened = np.einsum("bij,bjk->bik", jacobian, covariance)
        off = (slope * moved).sum(axis=1) + np.einsum("bik,bik->b", widened, curvature)
        most = max(most, float(np.nanmax(abs(off))))
    return 0.5 * posterior.dt * most


def _derivatives(
    states: tuple[sp.Symbol, ...], barrier: sp.Expr, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (B, n) and Hessian (B, n, n) of h."""
    slopes = [sp.diff(barrier, s) for s in states]
    curves = [sp.diff(slope, s) for slope in slopes for s in states]
    values = tabulated(states, [*slopes, *curves])(x)
    n = len(states)
    return values[:, :n], values[:, n:].reshape(len(x), n, n)


def _rates(
    posterior: Posterior, x: np.ndarray, u: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return F (B, n), its Jacobian (B, n, n) and 1/2 tr(S F_xx) (B, n), by differences."""
    n, parts = len(posterior.mean), 1 + len(posterior.inputs)
    weights = np.einsum(
        "ipk,p->ki",
        posterior.mean.reshape(n, parts, -1),
        np.array([1.0, *(posterior.input_scale * u)]),
    )
    width = np.ptp(np.array(posterior.features.region), axis=1)

    def rate(at: np.ndarray) -> np.ndarray:
        return posterior.features.matrix(at) @ weights

    steps = np.diag(_SLOPE * width)
    jacobian = np.stack([(rate(x + h) - rate(x - h)) / (2.0 * h.sum()) for h in steps], axis=2)
    curved = np.zeros((len(x), n))
    steps = np.diag(_CURVE * width)
    for i, j in itertools.product(range(n), repeat=2):
        if covariance[:, i, j].any():
            a, b = steps[i], steps[j]
            second = (rate(x + a + b) - rate(x + a - b) - rate(x - a + b) + rate(x - a - b)) / (
                4.0 * a.sum() * b.sum()
            )
            curved += 0.5 * covariance[:, i, j, None] * second
    return rate(x), jacobian, curved


_SAMPLES = 8192
_STARTS = 64


@dataclass(frozen=True)
class PosteriorGuarantee:
    """(1 - delta) (h_0 - (m + e) T)/c, a bound on P(safe on [0, T]) of a robust `BayesianSCBF`.

    With probability 1 - delta of the posterior, A h of the true system is at least -(m + e)
    wherever X is in C and in the workspace, and h/c less what that costs is then a lower bound
    (`safe_envs.proofs.guarantees.stage_bound`). The posterior takes the prior, the
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
            per s, at sampled states; see `safe_envs.proofs.posterior.rate_bias`.
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
        return (1.0 - self.delta) * guarantees.stage_bound(
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

    rest = np.mean(problem.input_bounds, axis=1)

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
    bias = rate_bias(posterior, expression, np.array(problem.input_bounds), points)
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
    """Raise ConfigurationError where the data show a misfit or varying noise beyond chance."""
    # The regions of the weights and of sigma are for exact features and constant noise.
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
    """Raise ConfigurationError where C reaches beyond the ranges of unbounded states."""
    # It may reach beyond the workspace, where episodes are at an end.
    if (level(region.beyond(rng, *workspace_of(problem))) >= 0.0).any():
        raise ConfigurationError(
            "C reaches beyond the states that are searched, so that neither sup h nor the shortfall"
            " is known"
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
