"""The assumptions of the bounds, in words: those that fail, and those that are not established."""

from __future__ import annotations

import numpy as np

from safe_envs.dynamics.lie import has_kinks
from safe_envs.wrappers.conditions import SRCBF
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.safe_set_analysis import SafeSetAnalysis


def no_bound(formulas: Formulas) -> str:
    """Say why there is no bound whatever the numbers are; "" if there may be one."""
    if not formulas.noisy:
        return ""
    for condition, stage in zip(formulas.conditions, formulas.stages, strict=True):
        if not condition.stochastic:
            return f"{condition.name} ignores the noise"
        if condition.chain_rates(stage.stop - stage.start) is None and not isinstance(
            condition, SRCBF
        ):
            return f"{condition.name} has no chain of rates, as the bounds need under noise"
    if not formulas.certain and any(isinstance(c, SRCBF) for c in formulas.conditions):
        return "the barriers have conditions of different kinds"
    return _kinked(formulas)


def _kinked(formulas: Formulas) -> str:
    """Say which function of a chain has a kink; "" if none has.

    The noise adds a local time there that the generator does not contain.
    """
    for barrier, row in zip(
        formulas.problem.barriers, formulas.safety_filter.constraints, strict=True
    ):
        for j, function in enumerate(row.chain):
            if has_kinks(function):
                what = barrier.name if j == 0 else f"b_{j} of {barrier.name}"
                return f"{what} is not twice differentiable, which Ito's formula asks for"
    return ""


def mismatch(formulas: Formulas) -> str:
    """Say in what the system that the conditions know differs from the plant; "" if in nothing."""
    plant, known = formulas.problem.plant, formulas.system
    parts = [
        n
        for n in ("drift", "input_matrix", "diffusion")
        if plant.numeric(getattr(plant, n)) != known.numeric(getattr(known, n))
    ]
    names = [p.name for p, value in plant.parameters.items() if known.parameters.get(p) != value]
    return f"the model differs from the plant in {', '.join(names or parts)}" if parts else ""


def failures(analysis: SafeSetAnalysis) -> list[str]:
    """Return the hypotheses that fail, apart from the shortfall, in words."""
    found = [mismatch(analysis.formulas), _undefined(analysis), analysis.rough]
    if analysis.runaway:
        found.append("it asks for unbounded control towards the edge")
    return [reason for reason in found if reason]


def unverified_assumptions(analysis: SafeSetAnalysis) -> list[str]:
    """Return the assumptions that are not established even as an estimate, in words."""
    found = [analysis.limits]
    if not analysis.formulas.joint:
        found.append("the shortfall of several conditions together is not established")
    return [reason for reason in found if reason]


def _undefined(analysis: SafeSetAnalysis) -> str:
    if not len(analysis.undefined):
        return ""
    states = zip(analysis.formulas.problem.states, analysis.undefined[0].tolist(), strict=True)
    return (
        "the condition has no finite value at"
        f" {', '.join(f'{s.symbol} = {value:.3g}' for s, value in states)}"
    )


def amount(shortfall: float) -> str:
    """Say by how much a condition is violated."""
    return f"by up to {shortfall:.4g}"


def unbounded(analysis: SafeSetAnalysis) -> str:
    """Say which supremum is infinite, where one matters; "" if none is."""
    growing = (
        np.flatnonzero(np.isinf(analysis.suprema)) if not analysis.formulas.certain else np.empty(0)
    )
    return analysis.infinite(int(growing[0])) if growing.size else ""
