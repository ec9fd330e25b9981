"""What was learned, held against the truth: as a report and as a file."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from safe_envs.agents.jobs.fingerprint import package_versions
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.evaluation_report import describe_plant, describe_system
from safe_envs.scripts.reports.tables import make_table
from safe_envs.wrappers.learning import LearnedModel
from safe_envs.wrappers.learning.data.collection import draw_states
from safe_envs.wrappers.learning.data.transitions import Transitions

STATES = 1000
"""States at which truth and estimate are compared."""

_FRESH = 2
"""Second entry of the seed of these states; see `safe_envs.wrappers.learning.checks.Purpose`."""

_VANISHING = 1e-9
"""A truth smaller than this part of its estimate's error is 0, but for rounding."""

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

_ROUNDING = 1e-8
_NAMED = re.compile(r"(f|g|covariance|C)[\[(](\w+)(?:, (\w+))?[\])]")


@dataclass(frozen=True, eq=False)
class Function:
    """A learned function at some states.

    Attributes:
        name: of it.
        unit: empty if it is not known or 1.
        truth: values (B,).
        estimate: values (B,).
    """

    name: str
    unit: str
    truth: np.ndarray
    estimate: np.ndarray

    @property
    def size(self) -> float:
        """Root mean square of the truth."""
        return _rms(self.truth)

    @property
    def error(self) -> float:
        """Root mean square of the error."""
        return _rms(self.estimate - self.truth)

    @property
    def largest(self) -> float:
        """The largest error."""
        return float(abs(self.estimate - self.truth).max())

    @property
    def relative(self) -> float | None:
        """The error as a part of the truth; None where the truth is 0."""
        return (
            None
            if self.size <= _VANISHING * self.error or not self.size
            else self.error / self.size
        )

    @property
    def vanishes(self) -> bool:
        """Whether truth and estimate are 0 everywhere."""
        return not (self.truth.any() or self.estimate.any())


@dataclass(frozen=True)
class Source:
    """A file of data that was learned from.

    Attributes:
        path: of the file.
        shortest: of the steps, in s.
        longest: of the steps, in s.
        seed: of the data; None for data from elsewhere.
    """

    path: Path
    shortest: float
    longest: float
    seed: int | None

    @classmethod
    def of(cls, path: Path, data: Transitions) -> Source:
        """What there is to say of data from a file."""
        return cls(path, float(data.dt.min()), float(data.dt.max()), data.seed)

    def __str__(self) -> str:
        steps = (
            f"{self.shortest:g} s"
            if self.shortest == self.longest
            else f"{self.shortest:g} to {self.longest:g} s"
        )
        return (
            f"in steps of {steps},"
            f" {'from elsewhere' if self.seed is None else f'of the seed {self.seed}'}"
        )


@dataclass(frozen=True, eq=False)
class Identification:
    """What was learned, and how well.

    Attributes:
        env_id: of which env.
        title: how results call it.
        problem: of which problem.
        learned: what was learned.
        functions: truth and estimate of each learned function; or why they cannot be compared.
        options: arguments of `gym.make` that were given.
        seed: that was given.
        source: file of data that was learned from, if any.
        out: where the model was written.
        use: a command that uses it.
    """

    env_id: str
    title: str
    problem: SafetyProblem
    learned: LearnedModel
    functions: tuple[Function, ...] | str
    options: dict[str, Any]
    seed: int
    source: Source | None
    out: Path
    use: str

    @property
    def shown(self) -> list[Function]:
        """The functions that are not 0 in truth and estimate."""
        return (
            []
            if isinstance(self.functions, str)
            else [function for function in self.functions if not function.vanishes]
        )

    @property
    def setup(self) -> str:
        """What was stepped; with data from a file, only what they are compared with."""
        if self.source is None:
            return describe_system(self.problem)
        return f"compared with {describe_plant(self.problem)}, at states of the seed {self.seed}"

    @property
    def notes(self) -> list[str]:
        """What has to be known to read the numbers."""
        return [
            *self.learned.record.warnings,
            *([self.functions] if isinstance(self.functions, str) else []),
        ]


def compare(learned: LearnedModel, problem: SafetyProblem, seed: int) -> tuple[Function, ...] | str:
    """Hold the learned functions against the plant's at fresh states of the region that is
    explored; or say why there is no truth."""
    x = draw_states(problem, STATES, np.random.default_rng([seed, _FRESH]))
    try:
        pairs = learned.compare(problem, x)
    except ConfigurationError as error:
        return str(error)
    units = {v.symbol.name: v.unit for v in (*problem.states, *problem.inputs)}
    return tuple(
        Function(name, unit_of(name, units), truth, estimate)
        for name, (truth, estimate) in pairs.items()
    )


def unit_of(name: str, units: Mapping[str, str]) -> str:
    """The unit of an entry of drift, input matrix or covariance by its name; empty for others,
    whose barriers have none.

    Args:
        name: such as f[v], g[v, u], covariance[v, z].
        units: of states and inputs, by name.
    """
    match = _NAMED.fullmatch(name)
    if match is None:
        return ""
    kind, first, second = match.groups()
    parts = [(units[first], 1), ("s", -1)]
    if second is not None:
        parts.append((units[second], -1 if kind == "g" else 1))
    powers: Counter[str] = Counter()
    for unit, sign in parts:
        for i, factors in enumerate(unit.split("/")):
            for factor in factors.split():
                symbol, _, exponent = factor.partition("^")
                powers[symbol] += (-sign if i else sign) * int(exponent or 1)
    above = [f"{s}^{k}" if k > 1 else s for s, k in powers.items() if s != "1" and k > 0]
    below = [f"/{s}^{-k}" if k < -1 else f"/{s}" for s, k in powers.items() if s != "1" and k < 0]
    return (" ".join(above) or ("1" if below else "")) + "".join(below)


def print_report(console: Console, found: Identification) -> None:
    """Print what was learned from what, its errors, and how to use it."""
    record = found.learned.record
    title = Text(found.title, style="bold")
    origin = f"seed {found.seed}" if found.source is None else f"data {found.source.path}"
    title.append(f" | method {found.learned.method} | {origin}", style="not bold")
    title.append(f"\n{found.setup}", style="not bold")
    say(console, title)
    of, details = (
        ("", "") if found.source is None else (f" of {found.source.path}", f", {found.source}")
    )
    amount = (
        f"{record.transitions:,} transitions{of} that last {record.observed:,.6g} s"
        f" together{details}"
    )
    say(console, f"\nLearned in {_seconds(record.seconds)} from {amount}")
    say(
        console,
        "Settings:"
        f" {', '.join(f'{name} = {_setting(value)}' for name, value in record.settings.items())}",
    )
    if record.errors:
        _head(console, "Held-out errors", _ERRORS[record.settings.get("way", found.learned.method)])
        console.print(_errors_table(record.errors))
    if found.shown:
        _head(
            console,
            "Truth against estimate",
            f"the plant and what was learned of it at {STATES} fresh states",
        )
        console.print(_functions_table(found.shown))
    _say_vanishing(console, found)
    if found.notes:
        console.print()
    for note in found.notes:
        say(console, f"Note: {note}")
    say(console, f"\nWritten to {found.out}; to use it:\n  {found.use}")


def _say_vanishing(console: Console, found: Identification) -> None:
    names = (
        []
        if isinstance(found.functions, str)
        else [function.name for function in found.functions if function.vanishes]
    )
    more = len(names) - _MOST_NAMED
    if names:
        say(
            console,
            "\n0 in truth and estimate:"
            f" {', '.join(names[:_MOST_NAMED])}{f' and {more} more' if more > 0 else ''}",
        )


def document(found: Identification) -> dict[str, Any]:
    """The whole as JSON-able data; what is not finite is null."""
    functions = () if isinstance(found.functions, str) else found.functions
    return {
        "config": {
            "env_id": found.env_id,
            "options": found.options,
            "method": found.learned.method,
            "seed": found.seed,
            "data": None if found.source is None else str(found.source.path),
        },
        "versions": package_versions(),
        "file": str(found.out),
        "sha256": found.learned.sha256,
        "record": {**asdict(found.learned.record), "warnings": list(found.learned.record.warnings)},
        "states": STATES,
        "functions": [
            {
                "name": function.name,
                "unit": function.unit or None,
                **{
                    key: _finite(getattr(function, key))
                    for key in ("size", "error", "relative", "largest")
                },
            }
            for function in functions
        ],
        "notes": found.notes,
    }


def _errors_table(errors: Mapping[str, float]) -> Table:
    """Errors by name; where all names are of the form "what kind", a row for each what and a column
    for each kind."""
    split = [tuple(name.rpartition(" ")[::2]) for name in errors]
    whats, kinds = (list(dict.fromkeys(parts)) for parts in zip(*split, strict=True))
    if len(split) < len(whats) * len(kinds) or not all(
        what and kind.isidentifier() for what, kind in split
    ):
        whats, kinds, split = list(errors), ["error"], [(name, "error") for name in errors]
    values = dict(zip(split, errors.values(), strict=True))
    table = make_table("pr", "of", *kinds, indent=True)
    for what in whats:
        table.add_row(Text(what), *[_number(values[what, kind]) for kind in kinds])
    return table


def _functions_table(functions: Sequence[Function]) -> Table:
    units = any(function.unit for function in functions)
    titles = ("function", "truth, rms", "error, rms", "relative", "largest error")
    table = make_table("prrrrl", *titles, *["unit"] * units, indent=True)
    for function in functions:
        relative = "-" if function.relative is None else percent(function.relative)
        cells = [
            _number(function.size),
            _number(function.error),
            relative,
            _number(function.largest),
        ]
        table.add_row(Text(function.name), *cells, *([function.unit] if units else []))
    return table


def _head(console: Console, name: str, text: str) -> None:
    say(console, Text.assemble((f"\n{name}", "bold"), f": {text}"))


def _number(value: float) -> str:
    return f"{value:.3g}"


def _seconds(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"


def _setting(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def percent(share: float) -> str:
    """A share with two digits, without an exponent for a large one; a rounding error is only
    bounded."""
    if share < _ROUNDING:
        return f"< {100 * _ROUNDING:g} %"
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
