"""What speaks against the bounds of conditions, in words: no bound at all, a hypothesis that fails,
or one that is not established."""

from __future__ import annotations

import numpy as np

from safe_envs.dynamics.lie import has_kinks
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.safe_set_analysis import SafeSetAnalysis


def no_bound(formulas: Formulas) -> str:
    """Why nothing is promised whatever the numbers are, or ""."""
    if not formulas.noisy:
        return ""
    for condition, stage in zip(formulas.conditions, formulas.stages, strict=True):
        if not condition.stochastic:
            return f"{condition.name} ignores the noise"
        rates = condition.chain_rates(stage.stop - stage.start)
        if rates is None and not condition.almost_sure:
            return f"{condition.name} has no chain of rates, as the bounds need under noise"
    if not formulas.certain and any(c.almost_sure for c in formulas.conditions):
        return "the barriers have conditions of different kinds"
    return _kinked(formulas)


def _kinked(formulas: Formulas) -> str:
    """Which function of a chain has a kink, where the noise adds a local time that the generator
    does not see."""
    for barrier, row in zip(
        formulas.problem.barriers, formulas.safety_filter.constraints, strict=True
    ):
        for j, function in enumerate(row.chain):
            if has_kinks(function):
                what = barrier.name if j == 0 else f"b_{j} of {barrier.name}"
                return f"{what} is not twice differentiable, which Ito's formula asks for"
    return ""


def mismatch(formulas: Formulas) -> str:
    """In what the system that the conditions know differs from the plant, or ""."""
    plant, known = formulas.problem.plant, formulas.system
    parts = [
        n
        for n in ("drift", "input_matrix", "diffusion")
        if plant.numeric(getattr(plant, n)) != known.numeric(getattr(known, n))
    ]
    names = [p.name for p, value in plant.parameters.items() if known.parameters.get(p) != value]
    return f"the model differs from the plant in {', '.join(names or parts)}" if parts else ""


def failures(survey: SafeSetAnalysis) -> list[str]:
    """The hypotheses that fail, whatever a bound makes of a shortfall."""
    found = [mismatch(survey.formulas), _undefined(survey), survey.rough]
    if survey.runaway:
        found.append("it asks for unbounded control towards the edge")
    return [reason for reason in found if reason]


def unverified_assumptions(survey: SafeSetAnalysis) -> list[str]:
    """What is not established even as an estimate."""
    found = [survey.limits]
    if not survey.formulas.joint:
        found.append("the shortfall of several conditions together is not established")
    return [reason for reason in found if reason]


def _undefined(survey: SafeSetAnalysis) -> str:
    if not len(survey.undefined):
        return ""
    states = zip(survey.formulas.problem.states, survey.undefined[0].tolist(), strict=True)
    return (
        "the condition has no finite value at"
        f" {', '.join(f'{s.symbol} = {value:.3g}' for s, value in states)}"
    )


def amount(shortfall: float) -> str:
    """By how much a condition is missed, in words."""
    return f"by up to {shortfall:.4g}"


def unbounded(survey: SafeSetAnalysis) -> str:
    """Which supremum is infinite, where one matters; or ""."""
    growing = (
        np.flatnonzero(np.isinf(survey.suprema)) if not survey.formulas.certain else np.empty(0)
    )
    return survey.infinite(int(growing[0])) if growing.size else ""
