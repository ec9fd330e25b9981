"""The assumptions of the bounds, in words: what fails, is not established, or is contradicted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.kinks import edges
from safe_envs.dynamics.lie import has_kinks
from safe_envs.wrappers.conditions import Certified
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.results import RELATIVE, Extremum
from safe_envs.wrappers.verification.safe_set import in_workspace, workspace_of
from safe_envs.wrappers.verification.safe_set_analysis import SafeSetAnalysis
from safe_envs.wrappers.verification.smoothness import NOT_ESTABLISHED


def no_bound(formulas: Formulas) -> str:
    """Say why there is no bound whatever the numbers are; "" if there may be one."""
    if any(isinstance(condition, Certified) for condition in formulas.conditions):
        return "its bound is that of the certificate, and not one of the chain of h"
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
    functions = zip(formulas.names, formulas.chain_expressions, strict=True)
    return next(filter(None, (kinked(name, function) for name, function in functions)), "")


def kinked(name: str, function: Any) -> str:
    """Say that a function has a kink, where noise adds a local time to its generator; "" if not.

    Args:
        name: of the function.
        function: expression of the states.

    Returns:
        A text.
    """
    asked = "is not twice differentiable, which Ito's formula asks for"
    symbols = sorted(function.free_symbols, key=str)
    return f"{name} {asked}" if has_kinks(function) and edges(function, symbols, 2) else ""


def mismatch(formulas: Formulas) -> str:
    """Say in what the system that the conditions know differs from the plant; "" if in nothing."""
    plant, known = formulas.problem.plant, formulas.system
    theirs, ours = (
        {
            "drift": s.exact(s.drift),
            "input_matrix": s.exact(s.input_matrix),
            # Noises with the same covariance are the same.
            "diffusion": s.exact(s.diffusion * s.diffusion.T),
        }
        for s in (plant, known)
    )
    parts = [n for n, part in theirs.items() if not all(map(is_zero, part - ours[n]))]
    names = [p.name for p, value in plant.parameters.items() if known.parameters.get(p) != value]
    return f"the model differs from the plant in {', '.join(names or parts)}" if parts else ""


def failures(analysis: SafeSetAnalysis) -> list[str]:
    """Return the hypotheses that fail, apart from the shortfall, in words."""
    rough = "" if nearly_rough(analysis) else analysis.rough
    found = [mismatch(analysis.formulas), _undefined(analysis), rough]
    if analysis.runaway:
        found.append("it asks for unbounded control towards the edge")
    return [reason for reason in found if reason]


def nearly_rough(analysis: SafeSetAnalysis) -> str:
    """Say which function comes so near to a pole or kink that a search cannot tell; "" if none."""
    return analysis.rough if analysis.rough.startswith(NOT_ESTABLISHED) else ""


JOINT = "the shortfall of several conditions together is not established"
"""What is not known where conditions share the inputs and cannot all be met."""


def _undefined(analysis: SafeSetAnalysis) -> str:
    if not len(analysis.undefined):
        return ""
    states = zip(analysis.formulas.problem.states, analysis.undefined[0].tolist(), strict=True)
    return (
        "the condition has no finite value at"
        f" {', '.join(f'{s.symbol} = {value:.3g}' for s, value in states)}"
    )


def outside(formulas: Formulas, b: np.ndarray) -> str:
    """Say where the start is outside, by the value that is lowest.

    Args:
        formulas: of the chains.
        b: values of all b_j at the starts, shape (B, sum of the r).

    Returns:
        A text.
    """
    if (b > 0.0).any(axis=0).all():
        return "no start lies in all C_j at once"
    j = int(b.max(axis=0).argmin())
    stage = j - next(s.start for s in formulas.stages if s.start <= j < s.stop)
    return f"the start is outside C_{stage}: {formulas.names[j]} = {b[:, j].max():.4g}" + (
        " at most" if len(b) > 1 else ""
    )


def amount(shortfall: Extremum) -> str:
    """Say by how much a condition is violated at most or, where that is not proved, at least."""
    return shortfall.text("by up to", "by at least")


def missed_somewhere(shortfall: Extremum, negligible: float) -> str:
    """Say that the conditions cannot be met somewhere, or that this is not excluded; may be empty.

    Args:
        shortfall: of the conditions.
        negligible: below this a proved one is not worth a word.

    Returns:
        A text.
    """
    if shortfall.found:
        return f"no action meets the condition somewhere, {amount(shortfall)}"
    if not shortfall.is_proved or shortfall.proved <= negligible:
        return ""
    return (
        "that an action meets the condition everywhere is not proved, but that the best one misses"
        f" it by {shortfall.text()}"
    )


def infeasible(analysis: SafeSetAnalysis, shortfall: Extremum) -> str:
    """Say on which part of the invariant set the conditions cannot be met; "" if on none.

    Args:
        analysis: of the safe set.
        shortfall: of the conditions.

    Returns:
        A text.
    """
    formulas, part = analysis.formulas, analysis.infeasible
    if not shortfall.found:
        return ""
    share = f"about {100 * part:.2g} % of" if part else "a thin part of"
    where = "C" if formulas.first_order else "the intersection of the C_j"
    conditions = "the condition" if len(formulas.conditions) == 1 else "all conditions"
    return f"no action meets {conditions} on {share} {where}, {amount(shortfall)}"


def unbounded(analysis: SafeSetAnalysis) -> str:
    """Say which supremum is infinite, where one matters; "" if none is."""
    if analysis.formulas.certain or not np.isinf(analysis.suprema).any():
        return ""
    j = int(np.isinf(analysis.suprema).argmax())
    return f"sup {analysis.formulas.names[j]} {analysis.how_infinite(j)}"


def above_suprema(formulas: Formulas, suprema: Sequence[Extremum], x: np.ndarray) -> str:
    """Say which b_j is above its c_j at a state of the invariant set; "" if none is.

    Args:
        formulas: of the chains.
        suprema: of each chain function.
        x: states (B, n), those outside the set or the workspace among them.

    Returns:
        A text.
    """
    if formulas.certain:
        return ""  # No supremum matters there.
    b = formulas.chain(x[_inside(formulas, x)])
    most = np.array([each.value for each in suprema])
    for j in np.flatnonzero((b > most * (1.0 + RELATIVE)).any(axis=0)).tolist():
        return reaches(formulas.names[j], float(b[:, j].max()), suprema[j])
    return ""


def above_shortfall(formulas: Formulas, shortfall: Extremum, x: np.ndarray, u: np.ndarray) -> str:
    """Say by how much actions violate the conditions, if by more than was found; "" if not.

    Args:
        formulas: of the conditions.
        shortfall: the largest one.
        x: states (E, n); those outside the invariant set do not count.
        u: actions (E, m).

    Returns:
        A text.
    """
    inside = _inside(formulas, x)
    if not inside.any():
        return ""
    a, b = formulas.constraints_at(x[inside])
    moved = np.einsum("eki,ei->ek", a, u[inside])
    # Where a condition has no finite value nothing can be said of by how much it is violated.
    most = shortfall.value
    more = np.nan_to_num(-(moved + b) - most, nan=0.0) > RELATIVE * (most + abs(moved) + abs(b))
    return violated_by(float(np.where(more, -(moved + b), 0.0).max()), shortfall) * bool(more.any())


def reaches(name: str, value: float, supremum: Extremum) -> str:
    """Say that a function is above its supremum.

    Args:
        name: of the function.
        value: that it has.
        supremum: of the function.

    Returns:
        A text.
    """
    return f"{name} reaches {value:.4g}, above the supremum of {_sourced(supremum)}"


def violated_by(most: float, shortfall: Extremum) -> str:
    """Say that a filter violated its condition by more than the shortfall.

    Args:
        most: by how much, in the units of b_(r-1) per s.
        shortfall: of the condition.

    Returns:
        A text.
    """
    return (
        f"the filter violated the condition by {most:.4g}, more than the shortfall of"
        f" {_sourced(shortfall)}"
    )


def _sourced(number: Extremum) -> str:
    source = "is proved" if number.is_proved else "the search found"
    return f"{number.value:.4g} that {source}"


def _inside(formulas: Formulas, x: np.ndarray) -> np.ndarray:
    """Return which states are in the invariant set and in the workspace, shape (B,)."""
    return np.all(formulas.chain(x) > 0.0, axis=1) & in_workspace(x, workspace_of(formulas.problem))
