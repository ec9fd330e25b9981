"""The answer of `safe-envs verify`, and the same as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from safe_envs.agents.evaluation.safety_chain import Horizon, MeasuredSafety, SafetyChain
from safe_envs.agents.evaluation.statistics import percent_in
from safe_envs.agents.evaluation.table import (
    COMPUTED,
    attainable_text,
    bound_text,
    continuous_text,
    describe_system,
    held_text,
    is_certified,
)
from safe_envs.filters.conditions.text import spec_of
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.feasibility import SMALL, SetFeasibility, Verification
from safe_envs.proofs.guarantees import HOLDING, Bound, CertificateGuarantee, Extremum
from safe_envs.proofs.judge import JudgeResult
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import number_text, print_rows, share_text, state_text
from safe_envs.text import percent_at_least


@dataclass(frozen=True, eq=False)
class VerifyAnswer:
    """What was found about a filter.

    Attributes:
        title: of the env.
        config: what was asked for, as JSON.
        policy: name of the simulated policy.
        verification: where the conditions can be met.
        starts: for which the bounds are, shape (B, n).
        bounds: on the probability of no violation.
        measurements: of that probability; none without a simulation.
        chain: the bound for held input, the measured rate, and what any policy can attain.
    """

    title: str
    config: dict[str, Any]
    policy: str
    verification: Verification
    starts: np.ndarray
    bounds: Sequence[Bound]
    measurements: Sequence[MeasuredSafety]
    chain: SafetyChain

    @property
    def statements(self) -> list[tuple[str, JudgeResult]]:
        """All that a bound asks for, with the judge's word; none without an invariant set."""
        if self.verification.invariant_set is None:
            return []
        found = self.verification.guarantee.statements
        # Where no number is proved, none is finite.
        return [(text.replace("<= infinite", "is finite"), verdict) for text, verdict in found]

    @property
    def judged_region(self) -> str:
        """What the G of the statements is, in words."""
        of_certificate = isinstance(self.verification.guarantee, CertificateGuarantee)
        positive = "psi and all h are" if of_certificate else "all b_j are"
        return f"G is where {positive} positive, in the workspace"

    @property
    def filter_text(self) -> str:
        """The conditions of the filter."""
        return spec_of(self.verification.formulas.conditions)

    def document(self) -> dict[str, Any]:
        """Return all as strict JSON: what is infinite or not defined is null."""
        found = self.verification
        return _plain(
            {
                "config": {
                    **self.config,
                    "filter": self.filter_text,
                    "knowledge": found.formulas.knowledge,
                    "horizon": found.problem.duration,
                },
                "states": [s.symbol.name for s in found.problem.states],
                "drawn": found.analysis.safe.drawn,
                "notes": found.region.notes,
                "beyond_workspace": found.beyond,
                "undefined": found.undefined,
                "safe_set": _set(found, found.safe_set),
                "invariant_set": found.invariant_set and _set(found, found.invariant_set),
                "barriers": [_barrier(found, i) for i in range(len(found.barriers))],
                "statements": [
                    {"statement": text, **verdict._asdict()} for text, verdict in self.statements
                ],
                "bounds": [vars(b) for b in self.bounds],
                "measurements": [_measured(m) for m in self.measurements],
                "chain": self.chain.as_dict(),
            }
        )


def _set(found: Verification, part: SetFeasibility) -> dict[str, Any]:
    """Return the feasibility in a set; the number of a search has a name of its own."""
    shortfall = found.shortfall(part)
    return {**vars(part), "shortfall": shortfall.proved, "shortfall_found": shortfall.found}


def _barrier(found: Verification, i: int) -> dict[str, Any]:
    """Return what is known of a barrier; the numbers of a search have names of their own."""
    barrier, supremum, suprema = found.barriers[i], found.supremum(i), found.suprema(i)
    document = dict(vars(barrier))
    return {
        "name": document.pop("name"),
        "control_authority_found": document.pop("control_authority"),
        **document,
        "supremum": supremum.proved,
        "supremum_found": supremum.found,
        "suprema": [each.proved for each in suprema],
        "suprema_found": [each.found for each in suprema],
        "vanishes": barrier.vanishes,
        "unbounded": math.isinf(barrier.supremum),
    }


def _measured(found: MeasuredSafety) -> dict[str, Any]:
    horizons = [{**vars(h), "bounds": [vars(b) for b in h.bounds]} for h in found.horizons]
    shown = {key: getattr(found, key) for key in ("start", "state", "episodes", "repeats")}
    return {**shown, "horizons": horizons}


def _plain(value: Any) -> Any:
    match value:
        case dict():
            return {key: _plain(entry) for key, entry in value.items()}
        case list() | tuple():
            return [_plain(entry) for entry in value]
        case np.ndarray() | np.generic():
            return _plain(value.tolist())
        case float():
            return value if math.isfinite(value) else None
    return value


_NO_BOUND = ("hypothesis fails", "not established")
_COLORS = {
    "proved": "green",
    "estimated": "yellow",
    "hypothesis fails": "red",
    "withheld": "red",
    "no bound": "yellow",
    "not established": "yellow",
}

_PROVED = (
    "Proved: a theorem, whose hypotheses and numbers c and m the judge proved by interval branch"
    " and bound, rounded outwards, with exact rational parameters."
)
_ESTIMATED = (
    "Estimated: a theorem, of which the judge left a hypothesis or a number undecided. A search"
    " found no counterexample, and the numbers are its own where none is proved: what it missed"
    " would make the value smaller, or void."
)


def print_bounds(console: Console, answer: VerifyAnswer) -> None:
    """Print a table of the bounds.

    Args:
        console: to print on.
        answer: with the bounds.
    """
    problem, starts, bounds = answer.verification.problem, answer.starts, answer.bounds
    where = (
        f"at {state_text(problem, starts[0])}"
        if len(starts) == 1
        else f"on average over {len(starts)} starts {problem.start!r}"
    )
    title = ("\nBounds on the probability of no violation", "bold")
    say(console, Text.assemble(title, f" {where}, T = {problem.duration:g} s"))
    rows = []
    for i, bound in enumerate(bounds, start=1):
        empty = bound.status in HOLDING and not bound.value
        status = Text.assemble((bound.status, _COLORS[bound.status]), ", but empty" * empty)
        rows.append((str(i), bound.name, _value(bound), status, bound.reason))
    print_rows(console, "lprpp", ("", "bound", "value", "status", "why"), rows)
    statuses = {bound.status for bound in bounds}
    for text in [_PROVED] * ("proved" in statuses) + [_ESTIMATED] * ("estimated" in statuses):
        say(console, text)
    if any(_in_brackets(bound) for bound in bounds):
        say(
            console,
            "In brackets: the value of a formula whose hypotheses fail here or are not established;"
            " that is no bound.",
        )


def print_measurements(console: Console, answer: VerifyAnswer) -> None:
    """Print a table for each measurement, and which bounds they contradict.

    Args:
        console: to print on.
        answer: with bounds and measurements.
    """
    numbers = {bound.name: str(i) for i, bound in enumerate(answer.bounds, start=1)}
    problem = answer.verification.problem
    for found in answer.measurements:
        at = "" if found.state is None else f", {state_text(problem, found.state)}"
        episodes = (
            f"{found.episodes} episode{'s' * (found.episodes != 1)} of the policy {answer.policy}"
        )
        heading = f" from {found.start}{at}: {episodes}"
        say(console, Text.assemble(("\nMeasured", "bold"), heading))
        names = [bound.name for bound in found.horizons[0].bounds]
        titles = [f"bound {numbers.setdefault(n, str(len(numbers) + 1))}" for n in names]
        rows = []
        for horizon in found.horizons:
            rate = percent_in(horizon.rate, horizon.ci_low, horizon.ci_high)
            rows.append((f"{horizon.time:g} s", rate, *_cells(horizon, names)))
        print_rows(console, "r", ("T", "no violation [95 % interval]", *titles), rows)
        if found.repeats:
            say(console, "Nothing is random here: all episodes are one and the same.")
    if answer.measurements:
        say(console, f"\n{_verdict(answer.measurements, numbers)}")


def print_chain(console: Console, answer: VerifyAnswer) -> None:
    """Print the bound for held input, the measured rate, and what is attainable, in this order.

    Args:
        console: to print on.
        answer: with the chain.
    """
    chain, problem = answer.chain, answer.verification.problem
    heading = f"from the start {problem.start!r}, up to {problem.duration:g} s"
    say(console, Text.assemble(("\nThe env's own steps", "bold"), f" {heading}"))
    attainable = attainable_text(chain.best)
    titles = (
        "bound, held\u00a0input",
        "safe [95 % interval]",
        *["attain\u00adable"] * len(attainable),
        "bound, contin\u00aduous",
    )
    rate = (
        "not measured"
        if chain.rate is None or chain.ci_low is None or chain.ci_high is None
        else percent_in(chain.rate, chain.ci_low, chain.ci_high)
    )
    cells = (held_text(chain.bounds), rate, *attainable, continuous_text(chain.bounds))
    print_rows(console, "r", titles, [cells], names=0)
    held = chain.bounds.held_note
    if held:
        none = chain.bounds.held_bound is None
        word = chain.bounds.held_word
        worth = "no bound, " if none else f"{word}, " * (word in ("proved", "certified"))
        say(console, f"Held input: {worth}{held}.")
    if chain.best is not None and chain.best.contradiction:
        say(console, f"The attainable safety is withheld: {chain.best.contradiction}.")
    elif chain.best is not None and attainable:
        how = "certified" if is_certified(chain.best) else COMPUTED
        say(console, f"Attainable: what no policy exceeds, {how}.")


def _in_brackets(bound: Bound) -> bool:
    return bound.status in _NO_BOUND and bound.value is not None


def _value(bound: Bound) -> str:
    if bound.status == "proved":
        return bound_text(bound.value, "proved")
    if bound.status == "estimated" and bound.value is not None:
        return f"{percent_at_least(bound.value)} %"
    return f"({share_text(bound.value)})" if _in_brackets(bound) else share_text(bound.value)


def _cells(horizon: Horizon, names: Sequence[str]) -> Iterator[str | Text]:
    bounds = {bound.name: bound for bound in horizon.bounds}
    for name in names:
        value = "" if bounds[name].value is None else _value(bounds[name])
        contradicted = Text(f"contradicted {value}".strip(), style="red")
        yield contradicted if name in horizon.contradicted else value or "withheld"


def _verdict(measurements: Sequence[MeasuredSafety], numbers: Mapping[str, str]) -> str:
    horizons = [horizon for found in measurements for horizon in found.horizons]
    bounds = {bound.name: bound for horizon in horizons for bound in horizon.bounds}
    wrong = {name for horizon in horizons for name in horizon.contradicted}
    withheld = next((bound.reason for bound in bounds.values() if bound.status == "withheld"), "")
    if not bounds:
        return "There is no bound that the measurement could contradict."
    if not wrong:
        return f"Withheld: {withheld}" if withheld else "The measurement contradicts no bound."
    listing = "; ".join(
        f"{numbers[name]}, {bounds[name].status} ({name})"
        for name in sorted(wrong, key=lambda name: int(numbers[name]))
    )
    return (
        f"The measurement contradicts bound {listing}. The interval of the rate lies below it,"
        " with the 5 % of error shared by all comparisons of this report."
    )


_STATEMENT_COLORS = {"proved": "green", "refuted": "red", "undecided": "yellow"}


def print_statements(console: Console, answer: VerifyAnswer) -> None:
    """Print a table of the statements that the bounds ask for.

    Args:
        console: to print on.
        answer: with the statements.
    """
    statements = answer.statements
    if not statements:
        return
    say(console, Text.assemble(("\nHypotheses, judged", "bold"), f" {answer.judged_region}"))
    rows = [
        (
            text,
            Text(verdict.word, style=_STATEMENT_COLORS[verdict.word]),
            f"{verdict.boxes:,}",
            _why(answer.verification.problem, verdict),
        )
        for text, verdict in statements
    ]
    print_rows(console, "plrp", ("statement", "word", "boxes", "where, or why not"), rows)
    if any(verdict.word == "undecided" for _, verdict in statements):
        say(
            console,
            "Undecided: neither proved nor refuted. It may take more boxes, a smaller workspace, or"
            " another form of the same expressions.",
        )


def _why(problem: SafetyProblem, verdict: JudgeResult) -> str:
    if verdict.word == "refuted" and verdict.state is not None and len(verdict.state):
        return f"fails at {state_text(problem, verdict.state)}"
    if verdict.word == "undecided" and verdict.box is not None:
        return f"{verdict.reason}; open in {_box_text(problem, verdict.box)}"
    return verdict.reason


def _box_text(problem: SafetyProblem, box: np.ndarray) -> str:
    ends = zip(problem.states, *box.tolist(), strict=True)
    return ", ".join(f"{s.symbol} in [{low:.3g}, {high:.3g}]" for s, low, high in ends)


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
            f"Barrier {barrier.name}: {order}with {barrier.filter}",
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
