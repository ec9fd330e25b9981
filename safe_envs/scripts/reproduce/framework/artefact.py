"""A table or figure of the thesis: how it is computed and drawn, and its outcome."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, get_type_hints

import matplotlib as mpl
from matplotlib.figure import Figure

from safe_envs.agents.evaluation.statistics import rate_interval, repeated_interval
from safe_envs.errors import require_whole
from safe_envs.scripts.figures.style import STYLE
from safe_envs.scripts.options.figure_options import WIDTHS


@dataclass(frozen=True)
class Workload:
    """How much is simulated.

    Attributes:
        episodes: of each rate in place of the thesis' number; None for that.
        seed: of all randomness.
        quick: a twentieth of the work, to see that it works.
    """

    episodes: int | None = None
    seed: int = 0
    quick: bool = False

    def __post_init__(self) -> None:
        require_whole("seed", self.seed, 0)
        if self.episodes is not None:
            require_whole("episodes", self.episodes, 1)

    def size(self, full: int) -> int:
        """Return the number of episodes, or of other repetitions that narrow the intervals.

        Args:
            full: their number in the full work.
        """
        return self.episodes or self.work(full)

    def work(self, full: int) -> int:
        """Return an amount of work that does not depend on the number of episodes, such as epochs.

        Args:
            full: in the full work.
        """
        return max(full // 20, min(full, 10)) if self.quick else full


@dataclass(frozen=True)
class Number:
    """A number of ours, with the printed one if there is one.

    Attributes:
        name: what it is of, unique in its artefact.
        ours: in `unit`.
        low: lower end of our 95 % interval, if it has one.
        high: upper end.
        printed: in `unit`; None where the thesis gives none.
        printed_trials: sample size of a printed rate.
        unit: "%" for rates, or that of SI.
    """

    name: str
    ours: float
    low: float | None = None
    high: float | None = None
    printed: float | None = None
    printed_trials: int | None = None
    unit: str = ""

    @property
    def suffix(self) -> str:
        """Return the unit as it follows a value."""
        return f" {self.unit}" if self.unit else ""

    @classmethod
    def rate(
        cls,
        name: str,
        safe: int,
        trials: int,
        printed: float | None = None,
        printed_trials: int | None = None,
    ) -> Number:
        """Return a safety rate in per cent, with its interval.

        Args:
            name: see the class.
            safe: how many of the trials.
            trials: ours.
            printed: in per cent.
            printed_trials: see the class.
        """
        low, high = rate_interval(safe, trials)
        return cls(name, 100 * safe / trials, 100 * low, 100 * high, printed, printed_trials, "%")

    @classmethod
    def mean(
        cls,
        name: str,
        values: Any,
        unit: str = "",
        least: float = -math.inf,
        most: float = math.inf,
    ) -> Number:
        """Return the mean over independent repetitions, such as episodes, with Student's interval.

        Args:
            name: see the class.
            values: of the repetitions, shape (R,); a single one says nothing but the bounds.
            unit: see the class.
            least: lower bound of the quantity.
            most: upper bound.
        """
        mean = math.fsum(values) / len(values)
        bounds = least, most
        low, high = (
            repeated_interval(values, (mean, mean), 0.95, bounds) if len(values) > 1 else bounds
        )
        return cls(name, mean, low, high, unit=unit)


@dataclass(frozen=True)
class Claim:
    """A sentence as a computed check.

    Attributes:
        sentence: in our words.
        holds: computed.
        evidence: the numbers by which.
        printed: whether the thesis says it. A check of ours is shown, and counts for no verdict.
    """

    sentence: str
    holds: bool
    evidence: str
    printed: bool = True


@dataclass(frozen=True)
class Findings:
    """The outcome of an artefact, as JSON-able data.

    Attributes:
        numbers: of the artefact.
        claims: of its figure and of the text about it.
        alternative_settings: the same with other settings, by a name that says which.
        printed_formula: the same numbers by the printed formula, where that is wrong.
        data: what the picture shows, lists by name.
        notes: what else a reader should know, computed where it holds numbers.
    """

    numbers: list[Number] = field(default_factory=list)
    claims: list[Claim] = field(default_factory=list)
    alternative_settings: dict[str, Findings] = field(default_factory=dict)
    printed_formula: list[Number] = field(default_factory=list)
    data: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def document(self) -> dict[str, Any]:
        """Return all of it as JSON-able data."""
        return asdict(self)

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> Findings:
        """Return the outcome that `document` wrote.

        Raises:
            AttributeError, ArithmeticError, LookupError, TypeError, ValueError: it is of another
                shape.
        """
        data, notes = document["data"], document["notes"]
        if not isinstance(data, dict) or not all(isinstance(note, str) for note in notes):
            raise TypeError("its data is no object, or a note is no text")
        return cls(
            [_typed(Number, row) for row in document["numbers"]],
            [_typed(Claim, row) for row in document["claims"]],
            {
                name: cls.from_document(other)
                for name, other in document["alternative_settings"].items()
            },
            [_typed(Number, row) for row in document["printed_formula"]],
            data,
            notes,
        )


def _typed(kind: type, row: dict[str, Any]) -> Any:
    """Return the number or claim of a JSON object, whose entries are of its types."""
    hints = get_type_hints(kind)
    for name, value in row.items():
        # JSON does not tell 1.0 from 1.
        if not isinstance(value, hints[name]) and not (
            type(value) is int and isinstance(0.0, hints[name])
        ):
            raise TypeError(f"its {name} is {value!r}")
        if isinstance(value, int | float) and not math.isfinite(value):
            raise ValueError(f"its {name} is {value!r}")
    return kind(**row)


@dataclass(frozen=True)
class Artefact:
    """A table or figure of the thesis.

    Attributes:
        name: "table-4.1", "figure-3.2a", "example-4.2.2".
        title: what it shows, in our words.
        compute: does the work, with the project's public API only.
        setting: how, by what is simulated.
        assumptions: what the thesis leaves open, and what we take.
        errata: errors of the thesis that are not in ours, with the equation.
        argument: why it cannot be reproduced, for a verdict that says so.
        draw: fills an empty figure from the outcome; None for a table.
        size: of the figure; its shape is kept, and its width that of two columns of a paper.
    """

    name: str
    title: str
    compute: Callable[[Workload], Findings]
    setting: Callable[[Workload], tuple[str, ...]]
    assumptions: tuple[str, ...] = ()
    errata: tuple[str, ...] = ()
    argument: str = ""
    draw: Callable[[Figure, Findings], None] | None = None
    size: tuple[float, float] = (7.0, 4.2)

    def picture(self, outcome: Findings) -> Figure:
        """Return the figure of an artefact that has one, two columns of a paper wide.

        Args:
            outcome: of the artefact.
        """
        width, height = self.size
        wide = WIDTHS["double"]
        with mpl.rc_context(STYLE):
            figure = Figure(figsize=(wide, wide * height / width))
            if self.draw is not None:
                self.draw(figure, outcome)
        return figure
