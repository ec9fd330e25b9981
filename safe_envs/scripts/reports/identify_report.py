"""The answer of `safe-envs identify` as a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.text import Text

from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.identify_answer import STATES, Function, IdentifyAnswer
from safe_envs.scripts.reports.quantities import relative_text
from safe_envs.scripts.reports.tables import print_rows

_MOST_NAMED = 8
_ERRORS = {
    "learned-hocbf": "of the residuals: root mean square and 95 % quantile",
    "network": (
        "of the network against the labels, median; and what noise in the data makes of the labels,"
        " as their standard error"
    ),
    "direct": "of the covariances, root mean square",
    "bayesian": (
        "of the rates per s, root mean square; what noise in the data makes of it; and in standard"
        " deviations of the prediction"
    ),
}
"""What the held-out errors of each method are, or of its way."""


def print_report(console: Console, found: IdentifyAnswer) -> None:
    """Print what was learned from what, its errors, and how to use it.

    Args:
        console: to print on.
        found: to print.
    """
    record, source = found.learned.record, found.source
    origin = f"seed {found.seed}" if source is None else f"data {source.path}"
    told = f" | method {found.learned.method} | {origin}\n{found.setup}"
    say(console, Text.assemble((found.title, "bold"), told))
    of, details = ("", "") if source is None else (f" of {source.path}", f", {source}")
    amount = (
        f"{record.transitions:,} transitions{of} that last {record.observed:,.6g} s"
        f" together{details}"
    )
    say(console, f"\nLearned in {_seconds(record.seconds)} from {amount}")
    settings = (f"{name} = {_setting(value)}" for name, value in record.settings.items())
    say(console, f"Settings: {', '.join(settings)}")
    if record.errors:
        kind = _ERRORS[record.settings.get("way", found.learned.method)]
        say(console, Text.assemble(("\nHeld-out errors", "bold"), f": {kind}"))
        _print_errors(console, record.errors)
    shown = [function for function in found.compared if not function.vanishes]
    if shown:
        what = f"the plant and what was learned of it at {STATES} fresh states"
        say(console, Text.assemble(("\nTruth against estimate", "bold"), f": {what}"))
        _print_functions(console, shown)
    names = [function.name for function in found.compared if function.vanishes]
    if names:
        more = len(names) - _MOST_NAMED
        rest = f" and {more} more" if more > 0 else ""
        say(console, f"\n0 in truth and estimate: {', '.join(names[:_MOST_NAMED])}{rest}")
    if found.notes:
        console.print()
    for note in found.notes:
        say(console, f"Note: {note}")
    say(console, f"\nWritten to {found.out}; to use it:")
    say(console, f"  {found.use}", wrap=False)


def _print_errors(console: Console, errors: Mapping[str, float]) -> None:
    """Print errors by name, with a column for each kind if all names are "what kind"."""
    split = [tuple(name.rpartition(" ")[::2]) for name in errors]
    whats, kinds = (list(dict.fromkeys(parts)) for parts in zip(*split, strict=True))
    if len(split) < len(whats) * len(kinds) or not all(
        what and kind.isidentifier() for what, kind in split
    ):
        whats, kinds, split = list(errors), ["error"], [(name, "error") for name in errors]
    values = dict(zip(split, errors.values(), strict=True))
    rows = [(what, *(_number(values[what, kind]) for kind in kinds)) for what in whats]
    print_rows(console, "lr", ("of", *kinds), rows)


def _print_functions(console: Console, functions: Sequence[Function]) -> None:
    units = any(function.unit for function in functions)
    titles = ("function", "truth, rms", "error, rms", "relative", "largest error")
    rows = []
    for function in functions:
        relative = "-" if function.relative is None else relative_text(function.relative)
        cells = [
            _number(function.size),
            _number(function.error),
            relative,
            _number(function.largest),
        ]
        rows.append((function.name, *cells, *([function.unit] if units else [])))
    print_rows(console, "lrrrrl", (*titles, *["unit"] * units), rows)


def _number(value: float) -> str:
    return f"{value:.3g}"


def _seconds(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"


def _setting(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
