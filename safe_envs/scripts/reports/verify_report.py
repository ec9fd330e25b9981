"""What `safe-envs verify` found, as a report and as a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.text import Text

from safe_envs.agents.evaluation.bound_check import Horizon, Measurement
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.evaluation_report import describe_system
from safe_envs.scripts.reports.rates import percent, percent_in
from safe_envs.scripts.reports.tables import make_table
from safe_envs.wrappers import spec_of
from safe_envs.wrappers.verification.feasibility import SMALL, BarrierFindings, Part, Verification
from safe_envs.wrappers.verification.results import Bound

_NOTHING = 1e-6
"""What a coordinate of a state found by a search is off by, in parts of the workspace."""

_NO_BOUND = ("hypothesis fails", "not established")
_COLORS = {
    "estimated": "green",
    "hypothesis fails": "red",
    "withheld": "red",
    "no bound": "yellow",
    "not established": "yellow",
}


def print_report(
    console: Console,
    name: str,
    found: Verification,
    starts: np.ndarray,
    bounds: Sequence[Bound],
    policy: str,
    measurements: Sequence[Measurement],
) -> None:
    """Print the findings, the bounds and the measurements, a section each."""
    formulas = found.formulas
    problem = formulas.problem
    title = Text(name, style="bold")
    title.append(
        f" | filter {spec_of(formulas.conditions)} | start {problem.start}", style="not bold"
    )
    title.append(
        f"\n{describe_system(problem)}; the conditions know the {formulas.knowledge}",
        style="not bold",
    )
    say(console, title)
    _section(console, "Safe set", _set_lines(found, starts))
    for barrier in found.barriers:
        _section(
            console,
            f"Barrier {barrier.name}: relative degree {barrier.degree} with {barrier.condition}",
            _barrier_lines(found, barrier),
        )
    _section(
        console,
        "Where no action in the box meets the condition" + "s" * (len(found.barriers) > 1),
        _part_lines(found),
    )
    _print_bounds(console, found, starts, bounds)
    numbers = {bound.name: str(i) for i, bound in enumerate(bounds, start=1)}
    for measurement in measurements:
        _print_measurement(console, problem, policy, measurement, numbers)
    if measurements:
        say(console, _verdict(measurements, numbers))
    say(
        console,
        "\nSuprema, shortfalls and shares are estimates from samples and a local search. The"
        f" bounds are about conditions that are met at every instant, not every {problem.dt:g} s,"
        " and count leaving the workspace as an end, not as a violation.",
    )


def document(
    config: dict[str, Any],
    found: Verification,
    bounds: Sequence[Bound],
    measurements: Sequence[Measurement],
) -> dict[str, Any]:
    """All that was found as strict JSON: what is infinite or not defined is null."""
    formulas = found.formulas
    return _plain(
        {
            "config": {
                **config,
                "filter": spec_of(formulas.conditions),
                "knowledge": formulas.knowledge,
                "horizon": formulas.problem.duration,
            },
            "states": [s.symbol.name for s in formulas.problem.states],
            "drawn": found.drawn,
            "notes": found.region.notes,
            "beyond_workspace": found.beyond,
            "undefined": found.undefined,
            "safe_set": vars(found.safe_set),
            "invariant_set": vars(found.invariant_set) if found.invariant_set else None,
            "barriers": [
                {**vars(b), "vanishes": b.vanishes, "unbounded": math.isinf(b.supremum)}
                for b in found.barriers
            ],
            "bounds": [vars(b) for b in bounds],
            "measurements": [_measured(m) for m in measurements],
        }
    )


def _measured(found: Measurement) -> dict[str, Any]:
    horizons = [{**vars(h), "bounds": [vars(b) for b in h.bounds]} for h in found.horizons]
    return {key: getattr(found, key) for key in ("start", "state", "episodes", "repeats")} | {
        "horizons": horizons
    }


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


def _section(console: Console, title: str, lines: Sequence[str]) -> None:
    console.print(f"\n[bold]{escape(title)}[/]", soft_wrap=True, highlight=False)
    for line in lines:
        say(console, f"  {line}")


def _searched(found: Verification) -> str:
    """What shares are of: C, or what is left of it in ranges that were chosen for states without
    any."""
    return "the part of C that is searched" if found.beyond and found.region.chosen.any() else "C"


def _set_lines(found: Verification, starts: np.ndarray) -> list[str]:
    ranges = f" ({'; '.join(found.region.notes)})" if found.region.notes else ""
    lines = [
        (
            f"{found.drawn} states were drawn from the workspace{ranges}; C is"
            f" {_percent(found.safe_set.share)} of it, and {found.safe_set.points} of its states are"
            " looked at"
        ),
    ]
    if found.beyond and found.region.chosen.any():
        lines.append("C reaches beyond these ranges: shares and shortfalls are of the part inside")
    elif found.beyond:
        lines.append(
            "C reaches beyond the workspace: shares, shortfalls and suprema are of the part inside,"
            " where the episodes are"
        )
    if found.undefined:
        lines.append(
            f"a condition has no finite value on {_percent(found.undefined)} of {_searched(found)};"
            " nothing can be met or missed there"
        )
    if found.invariant_set is None:
        lines.append("the sets C_j = {b_j >= 0} have no state in common: nothing is kept")
    elif not found.formulas.first_order:
        lines.append(
            "the intersection of the C_j = {b_j >= 0}, which the condition keeps, is"
            f" {_percent(found.invariant_set.share)} of {_searched(found)}"
        )
        outside = _outside(found, starts)
        if outside:
            lines.append(
                f"{_percent(outside)} of the starts are in C and outside this intersection: nothing"
                " is promised from there"
            )
    return lines


def _outside(found: Verification, starts: np.ndarray) -> float:
    """The share of starts that are safe, but not in the set that the condition keeps."""
    chain = found.formulas.chain(starts)
    return float(
        ((chain[:, found.formulas.barriers] > 0.0).all(axis=1) & (chain <= 0.0).any(axis=1)).mean()
    )


def _barrier_lines(found: Verification, b: BarrierFindings) -> list[str]:
    problem = found.formulas.problem
    size = f"{_number(b.typical)} in the median"
    if b.vanishes:
        lines = [
            (
                f"control authority: it vanishes at {_state(problem, b.control_authority_at)}: there the input has"
                " no say, and the condition holds only if its offset is >= 0"
            ),
            f"  its reach over the box is {size}, below {100 * SMALL:g} % of that on"
            f" {_percent(b.small)} of {_searched(found)}"
            + (
                f"; no action meets the condition on {_percent(b.small_infeasible)} of this part"
                if b.small
                else ""
            ),
        ]
    else:
        lines = [
            "control authority: it vanishes nowhere in C; its reach over the box is at least"
            f" {_number(b.control_authority)}, {size}"
        ]
    missed = f"misses it by {_number(b.deepest_shortfall)}" if b.deepest_shortfall else "meets it"
    lines.append(
        f"deepest state of the workspace: h = {_number(b.deepest_h)} at"
        f" {_state(problem, b.deepest)}; there the best action {missed}"
    )
    if math.isinf(b.supremum):
        lines.append(f"sup h over C {b.growth}")
    else:
        over = (
            ""
            if b.degree == 1
            else " over the intersection: "
            + ", ".join(f"c_{j} = {_number(c)}" for j, c in enumerate(b.suprema))
        )
        lines.append(
            f"sup h over C = {_number(b.supremum)};{over}"
            if over
            else f"sup h over C = c = {_number(b.supremum)}"
        )
    return lines


def _part_lines(found: Verification) -> list[str]:
    parts = [(_searched(found), found.safe_set)]
    if found.invariant_set is not None and not found.formulas.first_order:
        parts.append(("the intersection", found.invariant_set))
    return [f"{name}: {_describe_part(found, part)}" for name, part in parts]


def _describe_part(found: Verification, part: Part) -> str:
    at = _state(found.formulas.problem, part.worst)
    if not part.shortfall:
        return f"nowhere; the least to spare is at {at}"
    share = (
        _percent(part.infeasible) if part.infeasible else f"less than {_percent(1.0 / part.points)}"
    )
    return f"{share}, missed by up to {_number(part.shortfall)} at {at}"


def _print_bounds(
    console: Console, found: Verification, starts: np.ndarray, bounds: Sequence[Bound]
) -> None:
    problem = found.formulas.problem
    where = (
        f"at {_state(problem, starts[0])}"
        if len(starts) == 1
        else f"on average over {len(starts)} starts {problem.start!r}"
    )
    console.print(
        f"\n[bold]Bounds on the probability of no violation[/] {escape(where)}, T ="
        f" {problem.duration:g} s",
        highlight=False,
    )
    titles = ("", "bound", "value", "status with the c and m found", "why")
    table = make_table("lprp", *titles, indent=True)
    for i, bound in enumerate(bounds, start=1):
        empty = bound.status == "estimated" and not bound.value
        status = f"[{_COLORS[bound.status]}]{bound.status}[/]{', but empty' if empty else ''}"
        table.add_row(str(i), escape(bound.name), _value(bound), status, escape(bound.reason))
    console.print(table)
    if any(bound.status == "estimated" for bound in bounds):
        say(
            console,
            "Estimated: a theorem, with the c and m found. Larger ones that the search missed would"
            " make the bound smaller.",
        )
    if any(bound.status in _NO_BOUND and bound.value is not None for bound in bounds):
        say(
            console,
            "In brackets: what a formula gives whose hypotheses fail here, or whose proof does;"
            " that is no bound.",
        )


def _value(bound: Bound) -> str:
    return (
        f"({_percent(bound.value)})"
        if bound.status in _NO_BOUND and bound.value is not None
        else _percent(bound.value)
    )


def _print_measurement(
    console: Console,
    problem: SafetyProblem,
    policy: str,
    found: Measurement,
    numbers: dict[str, str],
) -> None:
    at = "" if found.state is None else f", {_state(problem, found.state)}"
    heading = f"from {found.start}{at}: {found.episodes} episodes of the policy {policy}"
    console.print(f"\n[bold]Measured[/] {escape(heading)}", highlight=False, soft_wrap=True)
    names = [bound.name for bound in found.horizons[0].bounds]
    bounds = [f"bound {numbers.setdefault(n, str(len(numbers) + 1))}" for n in names]
    table = make_table("r", "T", "no violation [95 % interval]", *bounds, indent=True)
    for horizon in found.horizons:
        table.add_row(
            f"{horizon.time:g} s",
            escape(percent_in(horizon.rate, horizon.ci_low, horizon.ci_high)),
            *_marked(horizon, names),
        )
    console.print(table)
    if found.repeats:
        say(console, "Nothing is random here: all episodes are one and the same.")


def _marked(horizon: Horizon, names: Sequence[str]) -> list[str]:
    bounds = {bound.name: bound for bound in horizon.bounds}
    return [_cell(bounds[n], n in horizon.contradicted) for n in names]


def _cell(bound: Bound, contradicted: bool) -> str:
    if bound.value is None:
        return "[red]contradicted[/]" if contradicted else "withheld"
    return f"[red]contradicted {_value(bound)}[/]" if contradicted else _value(bound)


def _verdict(measurements: Sequence[Measurement], numbers: dict[str, str]) -> str:
    bounds = {bound.name: bound for m in measurements for h in m.horizons for bound in h.bounds}
    wrong = {name for m in measurements for h in m.horizons for name in h.contradicted}
    withheld = next((bound.reason for bound in bounds.values() if bound.status == "withheld"), "")
    if not bounds:
        return "\nThere is no bound that the measurement could contradict."
    if not wrong:
        return (
            "\nThe measurement contradicts no bound." if not withheld else f"\nWithheld: {withheld}"
        )
    listing = "; ".join(
        f"{numbers[name]}, {bounds[name].status} ({name})"
        for name in sorted(wrong, key=lambda name: int(numbers[name]))
    )
    return (
        f"\nThe measurement contradicts bound {listing}. The interval of the rate lies below it,"
        " with the 5 % of error shared by all comparisons of this report."
    )


def _state(problem: SafetyProblem, x: np.ndarray) -> str:
    parts = []
    for s, value in zip(problem.states, x.tolist(), strict=True):
        width = s.high - s.low if math.isfinite(s.high - s.low) else 1.0
        parts.append(f"{s.symbol} = {value if abs(value) > _NOTHING * width else 0.0:.3g}")
    return f"({', '.join(parts)})"


def _number(value: float) -> str:
    return "infinite" if math.isinf(value) else f"{value:.5g}"


def _percent(share: float | None) -> str:
    """A share with two digits below 1 %, so that a small one is not read as none."""
    return (
        percent(share) if share is None or share == 0.0 or share >= 0.01 else f"{100 * share:.2g} %"
    )
