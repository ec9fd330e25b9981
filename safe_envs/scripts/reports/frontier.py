"""The frontier of risk and return as a report and as JSON."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from safe_envs.agents.evaluation.frontier import Frontier, FrontierPoint
from safe_envs.agents.evaluation.statistics import percent_in
from safe_envs.agents.evaluation.table import describe_system
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import print_rows
from safe_envs.text import percent_at_least

_COUNTED = {
    "violation": "leaving the workspace counts as a violation",
    "safe": "leaving the workspace counts as the end of a safe episode",
}


def print_report(console: Console, title: str, found: Frontier) -> None:
    """Print the points, what the curve has at their risk, and where it comes from.

    Args:
        console: to print on.
        title: of the env.
        found: the curve and the points.
    """
    values = found.values
    counted = _COUNTED[values.settings.leaving]
    heading = f"\n{describe_system(found.problem)}; {counted}"
    say(console, Text.assemble((title, "bold"), heading))
    confidence = f"[{100 * found.confidence:.10g} % interval]"
    titles = (
        "point",
        f"violations {confidence}",
        f"return {confidence}",
        "below the curve",
        "least violations for this return",
    )
    rows = [
        (
            point.name,
            percent_in(point.violation_rate, point.violation_low, point.violation_high),
            _return(point),
            f"{found.cost(point):.4g}",
            f"{percent_at_least(found.needed(point))} %",
        )
        for point in (*found.points, *found.attained)
    ]
    console.print()
    print_rows(console, "lr", titles, rows)
    console.print()
    grid = "x".join(map(str, values.safe_grid.counts))
    names = ", ".join(map(str, values.given.small.symbols))
    for line in (
        f"The curve is computed from {len(values.prices)} prices of a violation on {grid} nodes of"
        f" ({names}) in {values.seconds:.1f} s, with an error of the grid that is not bounded: it"
        " does not show that no policy can cross it.",
        "`price` names the policies that these prices lead to: they show that it is attained.",
        *(
            [
                f"Points lie above the curve by {found.excess:.4g} beyond their intervals: so large"
                " is the error of this grid; give more --cells."
            ]
            * (found.excess > 0.0)
        ),
        *(f"Left out: {name} ({reason})" for name, reason in found.left_out.items()),
    ):
        say(console, line)


def document(found: Frontier, config: dict[str, Any]) -> dict[str, Any]:
    """Return the result as JSON-able data.

    Args:
        found: the curve and the points.
        config: what was asked for.
    """
    return {"config": config, **found.document()}


def _return(point: FrontierPoint) -> str:
    return f"{point.return_mean:.5g} [{point.return_low:.5g}, {point.return_high:.5g}]"
