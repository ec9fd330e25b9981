"""Constraints of conditions that know that the state is an estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import sympy as sp

from safe_envs.dynamics.min_max import clauses
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.barrier import Barrier
from safe_envs.wrappers.conditions.base import Condition
from safe_envs.wrappers.conditions.belief import (
    belief_barrier,
    belief_symbols,
    belief_system,
    standard_deviations,
)
from safe_envs.wrappers.conditions.bounded_error import Region, with_bounded_error
from safe_envs.wrappers.conditions.chain import require_smooth
from safe_envs.wrappers.conditions.constraint import AffineConstraint


@dataclass(frozen=True)
class EstimateSettings:
    """What conditions at an estimate need to know besides a model and a barrier.

    Attributes:
        dt: control period in s; None if it is not known.
        instants: K + 1 control instants of an episode, which share the probability `belief`.
        region: box that holds the true and the measured states, for `measurement_error`.
        certain: places of states that the estimator knows without any uncertainty.
    """

    dt: float | None = None
    instants: int | None = None
    region: Region | None = None
    certain: tuple[int, ...] = ()


def constraint_at_estimate(
    condition: Condition,
    model: ControlAffineSDE,
    barrier: Barrier,
    settings: EstimateSettings,
    count: int,
) -> AffineConstraint:
    """Return the constraint of a condition, at the true state or at an estimate as it asks.

    Args:
        condition: of the barrier.
        model: that the filter knows.
        barrier: h.
        settings: see there.
        count: of constraints that share the probability `belief`.

    Raises:
        ConfigurationError: A setting is missing, or the condition is none for estimates.
    """
    if condition.belief is None and not condition.measurement_error:
        return condition.constraint(model, barrier)
    plain = replace(condition, belief=None, measurement_error=())
    if condition.autonomous or condition.is_learned:
        raise ConfigurationError(
            f"{condition.name} was learned or proved at true states: leave belief and"
            " measurement_error out, or take a condition of a model, such as scbf or hocbf"
        )
    if len(clauses(barrier.expression)[0]) > 1:
        raise ConfigurationError(
            f"barrier {barrier.name} = {barrier.expression} is a maximum, which {condition.name}"
            " keeps at true states only; leave belief and measurement_error out, or take a smooth"
            " function below it"
        )
    known = model
    if condition.belief is not None:
        if settings.instants is None or settings.dt is None:
            raise ConfigurationError(
                f"belief = {condition.belief}: it is shared by the control instants of an episode,"
                " whose number and length are not known; give instants=K+1 and dt=..., or make"
                " the filter by SafetyFilter.for_problem"
            )
        z = standard_deviations(condition.belief, settings.instants * count)
        barrier = belief_barrier(model, barrier, z, settings.dt, settings.certain)
        known = belief_system(model, settings.certain)
    found = plain.constraint(known, barrier)
    if condition.measurement_error:
        # The mean value theorem, too, takes slopes of what does not jump.
        require_smooth(known, barrier, [*found.coefficient, found.offset], False, kinks=True)
        found = with_bounded_error(
            found, known, condition.measurement_error, settings.region, condition.name
        )
    return found


def with_belief_signals(
    model: ControlAffineSDE, constraints: Sequence[AffineConstraint]
) -> ControlAffineSDE:
    """Return a model with those symbols of a belief as signals that constraints hold.

    Args:
        model: that the filter knows.
        constraints: of the filter.
    """
    used: set[sp.Basic] = set()
    for c in constraints:
        for part in (*c.coefficient, c.offset, *c.chain, c.demand, c.change, *c.domain):
            used |= set() if part is None else part.free_symbols
    found = [s for group in belief_symbols(model.n) for s in group if s in used]
    if not found:
        return model
    return replace(model, signals={**model.signals, **dict.fromkeys(found, 0)})


def belief_places(symbols: Sequence[sp.Symbol], n: int) -> list[int]:
    """Return which of the values of `BeliefTracker.believed` some symbols stand for.

    Args:
        symbols: that a filter is given at run time; those of no belief are left out.
        n: number of states.
    """
    place = {s: i for i, s in enumerate(s for group in belief_symbols(n) for s in group)}
    return [place[s] for s in symbols if s in place]
