"""The answer of `safe-envs identify`: learned functions and the truth, and the same as JSON."""

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
from rich.text import Text

from safe_envs.agents.evaluation.table import describe_plant, describe_system
from safe_envs.agents.jobs.store import package_versions
from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning.collection import draw_states, sensor_deviations
from safe_envs.filters.learning.data import Transitions
from safe_envs.filters.learning.models.base import LearnedModel
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import print_rows, relative_text

STATES = 1000
"""States at which truth and estimate are compared."""

_FRESH = 2
"""Second entry of the seed of these states; see `safe_envs.filters.learning.checks.Purpose`."""

_VANISHING = 1e-9
"""A truth smaller than this part of its estimate's error is 0, but for rounding."""

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
class DataFile:
    """A file of data that was learned from.

    Attributes:
        path: of the file.
        data: of the file.
    """

    path: Path
    data: Transitions

    def __str__(self) -> str:
        shortest, longest, seed = self.data.dt.min(), self.data.dt.max(), self.data.seed
        steps = f"{shortest:g} s" if shortest == longest else f"{shortest:g} to {longest:g} s"
        return f"in steps of {steps}, {'from elsewhere' if seed is None else f'of the seed {seed}'}"


@dataclass(frozen=True, eq=False)
class IdentifyAnswer:
    """A learned model and its accuracy.

    Attributes:
        env_id: of the env.
        title: of the env in results.
        problem: that was learned.
        learned: the model.
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
    source: DataFile | None
    out: Path
    use: str

    @property
    def compared(self) -> tuple[Function, ...]:
        """The functions that could be compared with the truth."""
        return () if isinstance(self.functions, str) else self.functions

    @property
    def setup(self) -> str:
        """The simulated system; with data from a file, that with which they are compared."""
        if self.source is None:
            return describe_system(self.problem)
        return f"compared with {describe_plant(self.problem)}, at states of the seed {self.seed}"

    @property
    def notes(self) -> list[str]:
        """Notes needed to read the numbers."""
        return [
            *self.learned.record.warnings,
            *self._of_sensor,
            *([self.functions] if isinstance(self.functions, str) else []),
        ]

    @property
    def _of_sensor(self) -> list[str]:
        """What the errors of a sensor do to what is learned."""
        if self.problem.measurement is None:
            return []
        sizes = sensor_deviations(self.problem)
        states = zip(self.problem.plant.states, sizes, strict=True)
        seen = "states were measured with the standard deviations " + ", ".join(
            f"{s.name} {size:g}" for s, size in states
        )
        if self.learned.record.settings.get("errors_in_variables"):
            return [f"{seen}; the bias of that is corrected, as far as the errors are Gaussian"]
        return [
            f"{seen}, and nothing corrects the bias of that: it is part of the errors above. The"
            " method bayesian corrects it (errors in variables), for polynomials of the states"
        ]

    def document(self) -> dict[str, Any]:
        """Return all as JSON-able data; what is not finite is null."""
        return {
            "config": {
                "env_id": self.env_id,
                "options": self.options,
                "method": self.learned.method,
                "seed": self.seed,
                "data": None if self.source is None else str(self.source.path),
            },
            "versions": package_versions(),
            "file": str(self.out),
            "sha256": self.learned.sha256,
            "record": {
                **asdict(self.learned.record),
                "warnings": list(self.learned.record.warnings),
            },
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
                for function in self.compared
            ],
            "notes": self.notes,
        }


def compare(learned: LearnedModel, problem: SafetyProblem, seed: int) -> tuple[Function, ...] | str:
    """Compare the learned functions with those of the plant, at fresh states.

    Args:
        learned: the model.
        problem: with the plant and the sampling domain.
        seed: of the states.

    Returns:
        Each function; or a text that says why there is no truth.
    """
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
    """Return the unit of an entry of drift, input matrix or covariance.

    Args:
        name: such as f[v], g[v, u], covariance[v, z].
        units: of states and inputs, by name.

    Returns:
        Empty for other names, of functions of barriers, which have no unit.
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


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


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
