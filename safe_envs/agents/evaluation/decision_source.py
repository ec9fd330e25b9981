"""What decides on inputs in a compiled program of episodes or paths."""

from __future__ import annotations

from safe_envs.agents.evaluation.resolved import FilterParts, ResolvedEvaluation
from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers import SafetyFilter
from safe_envs.wrappers.backup import BackupFilter, BackupSettings
from safe_envs.wrappers.conditions.filter_settings import FilterSettings
from safe_envs.wrappers.filter_qp import FilterQP
from safe_envs.wrappers.filter_qp.filter_source import filter_source, unfiltered_source

Decider = FilterQP | BackupFilter
"""What decides: a QP of conditions, or a filter that acts by itself."""


def decider_of(resolved: ResolvedEvaluation, parts: FilterParts) -> Decider | None:
    """Return what decides under a filter; None for the unfiltered env.

    Args:
        resolved: what to simulate.
        parts: of the filter.

    Raises:
        NotCompilableError: NumPy alone can.
    """
    problem, spec = resolved.problem, resolved.spec
    if isinstance(parts, BackupSettings):
        return BackupFilter.for_problem(problem, parts, spec.knowledge)
    if isinstance(parts, FilterSettings):
        raise NotCompilableError(f"the filter {parts.text} {parts.not_compiled}")
    if not parts:
        return None
    return SafetyFilter.for_problem(problem, parts, spec.knowledge, spec.objective).qp


def decision_source(decider: Decider | None, inputs: int, data: Data) -> Source:
    """Return the function `decide` of `safe_envs.compiled.slots`.

    Args:
        decider: what decides; None to let every input pass.
        inputs: their number.
        data: receives the numbers.

    Raises:
        NotCompilableError: The filter has no compiled form.
    """
    if decider is None:
        return unfiltered_source(inputs)
    if isinstance(decider, BackupFilter):
        return decider.source(data)
    return filter_source(decider, data)
