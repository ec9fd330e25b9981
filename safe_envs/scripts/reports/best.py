"""The answer of `safe-envs best`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.text import Text

from safe_envs.agents.evaluation.attainable import AttainableSafety
from safe_envs.agents.evaluation.statistics import percent, percent_in
from safe_envs.agents.evaluation.table import COMPUTED, describe_system
from safe_envs.agents.jobs.store import package_versions
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import print_rows, size_text
from safe_envs.text import number_at_most, percents_between

_COUNTED = {
    "violation": "leaving the workspace in the safe set counts as a violation",
    "safe": "leaving the workspace in the safe set ends a safe episode, as evaluate counts it",
}


@dataclass(frozen=True, eq=False)
class BestAnswer:
    """How safe any policy can be in an env.

    Attributes:
        title: of the env.
        config: what was asked for, as JSON.
        problem: of the env.
        found: what was computed.
    """

    title: str
    config: dict[str, Any]
    problem: SafetyProblem
    found: AttainableSafety

    def document(self) -> dict[str, Any]:
        """Return all as JSON-able data."""
        return {"config": self.config, "versions": package_versions(), **self.found.as_dict()}


def print_best(console: Console, answer: BestAnswer) -> None:
    """Print the bounds, the greedy policy's rate, and the grid.

    Args:
        console: to print on.
        answer: to print.
    """
    found, problem = answer.found, answer.problem
    world = "the env" if found.knowledge == "plant" else "the model"
    told = (
        f" | best attainable safety in {world} | start {problem.start}"
        f"\n{describe_system(problem)}; {_COUNTED[found.leaving]}"
    )
    if found.specification:
        told += f"\nmet where {found.specification}"
    say(console, Text.assemble((answer.title, "bold"), told))
    word = ("met", "some policy meets it as often", "no policy meets it more often")
    if not found.specification:
        word = ("safe", "some policy is at least as safe", "no policy is safer")
    rows: list[tuple[str, str, str]] = []
    if found.lower is None or found.upper is None:
        ends = ("withheld", "withheld")
    else:
        ends = tuple(f"{end} %" for end in percents_between(found.lower, found.upper))
    rows.append(("lower", ends[0], word[1]))
    s = found.simulated
    if s is not None:
        rate = percent_in(s.rate, s.low, s.high)
        told = f"greedy policy, {s.episodes} episode{'s' * (s.episodes != 1)}, seed {s.seed}"
        rows.append(("simulated", rate, f"{told}, {100 * s.confidence:g} % interval"))
    rows.append(("upper", ends[1], word[2]))
    if s is not None:
        told = f"of the greedy policy, while still {word[0]}"
        rows.append(("P(leave)", percent(s.leave_rate), told))
    console.print()
    print_rows(console, "lrp", ("", word[0], ""), rows)
    console.print()
    for line in _grid_lines(found):
        say(console, line)
    if found.contradiction:
        say(console, f"Note: the bounds are withheld: {found.contradiction}")
    if found.lower == 0.0 and found.upper == 1.0:
        say(
            console,
            "Note: this grid is too coarse to say anything; the shorter the control period, the"
            " narrower cells have to be. More of them are asked for by --cells.",
        )
    for line in _word_lines(found, problem):
        say(console, line)


def _word_lines(found: AttainableSafety, problem: SafetyProblem) -> list[str]:
    """Return what kind of bounds the ends are."""
    check = found.check
    if check is None:
        return [f"Note: lower and upper are {COMPUTED}. They are not proved."]
    both = check.upper is not None
    ends = "lower and upper are" if both else "lower is"
    taken = f"{number_at_most(check.lower, 2)} is taken off the lower one"
    if check.upper is not None:
        taken += f", {number_at_most(check.upper, 2)} added to the upper one"
    told = (
        f"Note: {ends} certified: every cell at every step was checked by outward-rounded"
        f" arithmetic, in {check.seconds:.3g} s; {taken}."
    )
    lines = [told]
    if not both:
        lines.append(f"Note: upper is {COMPUTED}, and not checked: {check.unchecked}.")
    if problem.starts[problem.start].uniforms:
        lines.append("Note: the mean over the starts is from drawn ones, and holds with 99.99 %.")
    if check.assumed:
        lines.append(
            f"Note: taken for granted is {check.assumed}, which is checked at random states."
        )
    return lines


def _grid_lines(found: AttainableSafety) -> list[str]:
    count = " x ".join(map(str, found.cells))
    return [
        f"Coordinates: {'; '.join(found.coordinates)}",
        f"Grid: {count} cells, {found.inputs} inputs, {found.steps} steps; computed in"
        f" {found.seconds:.3g} s, table of {size_text(found.memory)}",
    ]
