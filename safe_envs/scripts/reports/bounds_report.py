"""Bounds on the safety of a filter, and measurements to compare them with, as a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from rich.console import Console
from rich.text import Text

from safe_envs.agents.evaluation.best_text import COMPUTED, attainable_text, is_certified
from safe_envs.agents.evaluation.bound_check import Horizon, MeasuredSafety
from safe_envs.agents.evaluation.bound_text import (
    bound_text,
    continuous_text,
    held_text,
)
from safe_envs.agents.evaluation.rate_text import percent_in
from safe_envs.outward_text import percent_at_least
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.quantities import share_text, state_text
from safe_envs.scripts.reports.tables import print_rows
from safe_envs.scripts.reports.verify_answer import VerifyAnswer
from safe_envs.wrappers.verification.results import HOLDING, Bound

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
            "In brackets: the value of a formula whose hypotheses fail here, or whose proof does;"
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
