"""The answer of `safe-envs verify` as a report."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.text import Text

from safe_envs.agents.evaluation.setting_text import describe_system
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.bounds_report import print_bounds, print_chain, print_measurements
from safe_envs.scripts.reports.judge_report import print_statements
from safe_envs.scripts.reports.quantities import number_text, share_text, state_text
from safe_envs.scripts.reports.verify_answer import VerifyAnswer
from safe_envs.wrappers.verification.feasibility import (
    SMALL,
    SetFeasibility,
    Verification,
)
from safe_envs.wrappers.verification.results import Extremum

_DIGITS = 6
"""Of extrema, as many as the judge's statements have."""


def print_report(console: Console, answer: VerifyAnswer) -> None:
    """Print the findings, the bounds and the measurements.

    Args:
        console: to print on.
        answer: to print.
    """
    found = answer.verification
    problem = found.problem
    told = (
        f" | filter {answer.filter_text} | start {problem.start}"
        f"\n{describe_system(problem)}; the conditions know the {found.formulas.knowledge}"
    )
    say(console, Text.assemble((answer.title, "bold"), told))
    _section(console, "Safe set", _set_lines(found, answer.starts))
    pairs = zip(found.barriers, found.formulas.conditions, strict=True)
    for i, (barrier, condition) in enumerate(pairs):
        # A barrier of its own, in the place of h, takes the input in its first derivative.
        order = f"relative degree {barrier.degree} " if condition.differentiates else ""
        _section(
            console,
            f"Barrier {barrier.name}: {order}with {barrier.condition}",
            _barrier_lines(found, i),
        )
    conditions = "conditions" if len(found.barriers) > 1 else "condition"
    _section(
        console, f"Where no action within the input bounds meets the {conditions}", _parts(found)
    )
    print_statements(console, answer)
    print_bounds(console, answer)
    print_measurements(console, answer)
    print_chain(console, answer)
    say(
        console,
        "\nShares are of sampled states, and what was found is of a local search: worse states may"
        " be left. What is proved holds at all states. The bounds but for that of held input are of"
        f" a filter that acts at every instant, not every {problem.dt:g} s, and count leaving the"
        " workspace as an end, not as a violation.",
    )


def _section(console: Console, title: str, lines: Sequence[str]) -> None:
    say(console, Text(f"\n{title}", style="bold"))
    for line in lines:
        say(console, f"  {line}")


def _searched(found: Verification) -> str:
    """Return what shares are of: C, or its part in ranges that were chosen for unbounded states."""
    return "the part of C that is searched" if found.beyond and found.region.assumed.any() else "C"


def _set_lines(found: Verification, starts: np.ndarray) -> list[str]:
    ranges = f" ({'; '.join(found.region.notes)})" if found.region.notes else ""
    lines = [
        f"{found.analysis.safe.drawn} states were drawn from the workspace{ranges}; C is about"
        f" {share_text(found.safe_set.share)} of it, and {found.safe_set.points} of its states are"
        " looked at"
    ]
    if found.beyond and found.region.assumed.any():
        lines.append("C reaches beyond these ranges: shares and shortfalls are of the part inside")
    elif found.beyond:
        lines.append(
            "C reaches beyond the workspace: shares, shortfalls and suprema are of the part inside,"
            " where the episodes are"
        )
    if found.undefined:
        lines.append(
            f"a condition has no finite value on about {share_text(found.undefined)} of"
            f" {_searched(found)}; it can be neither met nor violated there"
        )
    if found.invariant_set is None:
        lines.append(
            "no state was found that the sets C_j = {b_j >= 0} have in common: no invariant set"
        )
    elif not found.formulas.first_order:
        lines.append(
            "the intersection of the C_j = {b_j >= 0}, which the condition makes invariant, is"
            f" about {share_text(found.invariant_set.share)} of {_searched(found)}"
        )
        outside = _outside(found, starts)
        if outside:
            lines.append(
                f"{share_text(outside)} of the starts are in C and outside this intersection: no"
                " bound holds from there"
            )
    return lines


def _outside(found: Verification, starts: np.ndarray) -> float:
    """Return the share of starts that are safe, but outside the set that becomes invariant."""
    chain = found.formulas.chain(starts)
    return float(
        ((chain[:, found.formulas.barriers] > 0.0).all(axis=1) & (chain <= 0.0).any(axis=1)).mean()
    )


def _barrier_lines(found: Verification, i: int) -> list[str]:
    problem, b = found.problem, found.barriers[i]
    size = f"{number_text(b.typical)} in the median"
    if b.vanishes:
        share = share_text(b.small_infeasible)
        infeasible = f"; no action meets the condition on about {share} of it"
        at = state_text(problem, b.control_authority_at)
        lines = [
            f"control authority: it vanishes at {at}, where the input has no effect, and the"
            " condition holds only if its offset is >= 0",
            f"  its reach within the input bounds is {size}, below {100 * SMALL:g} % of that on"
            f" about {share_text(b.small)} of {_searched(found)}{infeasible * bool(b.small)}",
        ]
    else:
        lines = [
            "control authority: no state of C was found where it vanishes; its reach within the"
            f" input bounds is {number_text(b.control_authority)} at the least one found, {size}"
        ]
    shortfall = f"violates it by {number_text(b.deepest_shortfall)}"
    lines.append(
        f"deepest state found in the workspace: h = {number_text(b.deepest_h)} at"
        f" {state_text(problem, b.deepest)}; there the best action"
        f" {shortfall if b.deepest_shortfall else 'meets it'}"
    )
    supremum = found.supremum(i)
    if math.isinf(supremum.value):
        lines.append(f"sup h over C {b.growth}")
    elif b.degree == 1:
        lines.append(f"c = sup h over C {_relation(supremum)}")
    else:
        suprema = "; ".join(f"c_{j} {_relation(c)}" for j, c in enumerate(found.suprema(i)))
        lines.append(f"sup h over C {_relation(supremum)}; over the intersection: {suprema}")
    return lines


def _relation(number: Extremum) -> str:
    if math.isnan(number.found):
        return "is not known"
    if math.isinf(number.value):
        return "seems infinite"
    return number.text("<=", ">=", _DIGITS) + ", proved" * number.is_proved


def _parts(found: Verification) -> list[str]:
    parts = [(_searched(found), found.safe_set)]
    if found.invariant_set is not None and not found.formulas.first_order:
        parts.append(("the intersection", found.invariant_set))
    return [f"{name}: {_describe_part(found, part)}" for name, part in parts]


def _describe_part(found: Verification, part: SetFeasibility) -> str:
    at, shortfall = state_text(found.problem, part.worst), found.shortfall(part)
    if not part.shortfall:
        margin = f"the smallest margin found is at {at}"
        if shortfall.proved == 0.0:
            return f"nowhere, proved; {margin}"
        amount = f"; violated by {shortfall.text(digits=_DIGITS)}, proved" * shortfall.is_proved
        return f"no such state was found{amount}; {margin}"
    share = (
        f"about {share_text(part.infeasible)}"
        if part.infeasible
        else f"less than about {share_text(1.0 / part.points)}"
    )
    amount = shortfall.text(digits=_DIGITS)
    if shortfall.is_proved:
        worst = f"by {number_text(part.shortfall)} at {at}, the worst state found"
        return f"{share}, violated by {amount}, proved; {worst}"
    return f"{share}, violated by {amount} at {at}"
