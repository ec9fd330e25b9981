"""The certificate of an identified system: a probability that holds for every system that the data leave possible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from safe_envs.codegen import compile_function
from safe_envs.errors import ConfigurationError
from safe_envs.problem import SafetyProblem
from wrappers import bounds
from wrappers.conditions import BayesianSCBF, Condition
from wrappers.safe_set import Region, region_of, sample
from wrappers.safety_filter import SafetyFilter
from wrappers.search import largest

if TYPE_CHECKING:
    from wrappers.learning.posterior import Posterior

_SAMPLES = 8192
_BEYOND = 10.0
_BEYOND_LOG2 = 12


@dataclass(frozen=True)
class Certificate:
    """P(safe on [0, T]) >= (1 - delta) (h_0 - m T)/c for a simultaneous `BayesianSCBF`.

    With probability 1 - delta of the posterior, A h of the true system is at least -m wherever X is in C, and h/c less what m
    costs is then a lower bound (`wrappers.bounds.stage_bound`). The posterior takes the prior, the features and constant Gaussian
    noise for granted; c and m are found by sampling C and by a search, so that they are estimates from below.

    Attributes:
        delta: probability that the identification is outside its regions, delta_theta + delta_sigma.
        supremum: c, of h over C.
        shortfall: m, by how much the robust condition is missed where that is most, in the units of h per s.
        remark: what weakens it, in words; may be empty.
    """

    delta: float
    supremum: float
    shortfall: float
    remark: str
    _barrier: Any

    def at(self, starts: np.ndarray, horizon: float) -> np.ndarray:
        """The probability at starts (B, n) for a horizon in s, shape (B,)."""
        h = _values(self._barrier, np.asarray(starts, dtype=np.float64))
        return (1.0 - self.delta) * bounds.stage_bound(h, self.supremum, horizon, shortfall=self.shortfall)


def certificate(problem: SafetyProblem, conditions: Sequence[Condition], seed: int = 0) -> Certificate:
    """Find the certificate of a robust filter.

    Args:
        problem: whose barrier and box are taken; its plant and model do not matter.
        conditions: one, a `BayesianSCBF` with `simultaneous`.
        seed: of the search.

    Raises:
        ConfigurationError: there is another condition or more than one barrier, the data contradict what the posterior takes for
            granted, or C reaches beyond the workspace, where neither c nor m is known.
    """
    if len(conditions) != 1 or not isinstance(conditions[0], BayesianSCBF) or conditions[0].simultaneous is None:
        raise ConfigurationError("a certificate is for one barrier with bayesian-scbf:simultaneous=P")
    condition = conditions[0]
    _require_consistent(condition.learned)
    robust = SafetyFilter.for_problem(problem, condition)
    expression = condition.learned.system.numeric(problem.barriers[0].expression)
    barrier = compile_function(problem.plant.states, [expression], "arrays")
    row = robust.constraints[0]
    region = region_of(problem, condition.learned.system, [expression, *row.coefficient, row.offset])

    def level(x: np.ndarray) -> np.ndarray:
        return _values(barrier, x)

    rest = np.mean(problem.box, axis=1)

    def missed(x: np.ndarray) -> np.ndarray:
        return np.where(level(x) >= 0.0, robust.filter(x, np.broadcast_to(rest, (len(x), len(rest)))).slack[:, 0], -np.inf)

    _require_inside(level, region, np.random.default_rng([seed, 0]))
    points = sample("C", level, region, _SAMPLES, np.random.default_rng([seed, 1])).points
    highest, _ = largest(level, points, region, np.random.default_rng([seed, 2]))
    shortfall, _ = largest(missed, points, region, np.random.default_rng([seed, 3]))
    remark = f"no action meets the robust condition somewhere, by up to {shortfall:.3g}" if shortfall else ""
    return Certificate(condition.delta_theta + condition.delta_sigma, highest, shortfall, remark, barrier)


def _require_consistent(posterior: Posterior) -> None:
    """Whatever is beyond chance counts: the regions of the weights and of sigma are for exact features and constant noise."""
    for state, missed, varying in zip(posterior.features.states, posterior.misfit, posterior.variation, strict=True):
        if missed:
            raise ConfigurationError(f"the features miss {100 * missed:.3g} % of the rate of {state}, beyond chance; raise the degree")
        if varying:
            raise ConfigurationError(
                f"the variance of the noise of {state} varies by {100 * varying:.3g} %, beyond chance; a certificate is for constant noise"
            )


def _values(barrier: Any, x: np.ndarray) -> np.ndarray:
    return np.broadcast_to(barrier(*np.ascontiguousarray(x.T))[0], len(x))


def _require_inside(level: Any, region: Region, rng: np.random.Generator) -> None:
    wide = region.scaled(_BEYOND).draw(_BEYOND_LOG2, rng)
    outside = ((wide < region.low) | (wide > region.high)).any(axis=1)
    if (level(wide[outside]) >= 0.0).any():
        raise ConfigurationError("C reaches beyond the workspace, so that neither sup h nor the shortfall is known")
