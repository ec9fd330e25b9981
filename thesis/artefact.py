"""What an artefact of the thesis is (a figure, a table or an example), and what comes of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import yaml

from safe_envs.agents.evaluation.statistics import rate_interval, repeated_interval
from safe_envs.errors import require_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DATA = Path(__file__).parent / "data"
_CHAPTERS = (3, 4, 5, 6)


@dataclass(frozen=True)
class Sample:
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
        """Return the number of episodes, or of other repetitions that narrow the intervals."""
        return self.episodes or self.work(full)

    def work(self, full: int) -> int:
        """Return an amount of work that does not depend on the episodes, such as epochs."""
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
        """The unit as it follows a value."""
        return f" {self.unit}" if self.unit else ""

    @property
    def ends(self) -> tuple[float, float]:
        """The ends of the interval; the number itself where it has none."""
        if self.low is None or self.high is None:
            return self.ours, self.ours
        return self.low, self.high

    @property
    def interval(self) -> str:
        """The interval as text; empty without one."""
        form = ".1f" if self.unit in ("%", "points") else ".3g"
        low, high = self.ends
        return "" if self.low is None else f"[{low:{form}}, {high:{form}}]"

    @property
    def text(self) -> str:
        """Our number with its unit and interval; a difference in points has its sign."""
        form = {"%": ".1f", "points": "+.1f"}.get(self.unit, ".3g")
        return f"{self.ours:{form}}{self.suffix} {self.interval}".rstrip()

    def is_above(self, value: float = 0.0) -> bool:
        """Return whether the whole interval is above a value; False without an interval."""
        return self.low is not None and self.low > value

    def is_below(self, value: float = 0.0) -> bool:
        """Return whether the whole interval is below a value; False without an interval."""
        return self.high is not None and self.high < value

    @classmethod
    def rate(
        cls,
        name: str,
        safe: int,
        trials: int,
        printed: float | None = None,
        printed_trials: int | None = None,
    ) -> Number:
        """Return a safety rate in per cent, with its interval; `printed` is in per cent."""
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
        """Return the mean of independent repetitions, shape (R,), with Student's interval.

        The interval is within the bounds of the quantity, which are all that one repetition says.
        """
        mean = math.fsum(values) / len(values)
        low, high = least, most
        if len(values) > 1:
            low, high = repeated_interval(values, (mean, mean), 0.95, (least, most))
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "holds", bool(self.holds))  # NumPy's is not JSON


@dataclass(frozen=True)
class Outcome:
    """What comes of an artefact, as JSON-able data.

    Attributes:
        numbers: of the artefact.
        claims: of its figure and of the text about it.
        alternative_settings: the same with other settings, by a name that says which.
        printed_formula: the same numbers by the printed formula, where that is wrong.
        notes: what else a reader should know, computed where it holds numbers.
    """

    numbers: list[Number] = field(default_factory=list)
    claims: list[Claim] = field(default_factory=list)
    alternative_settings: dict[str, Outcome] = field(default_factory=dict)
    printed_formula: list[Number] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def document(self) -> dict[str, Any]:
        """Return all of it as JSON-able data."""
        return asdict(self)

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> Outcome:
        """Return the outcome that `document` wrote."""
        other = document["alternative_settings"].items()
        return cls(
            [Number(**row) for row in document["numbers"]],
            [Claim(**row) for row in document["claims"]],
            {name: cls.from_document(each) for name, each in other},
            [Number(**row) for row in document["printed_formula"]],
            list(map(str, document["notes"])),
        )


Draw = Callable[["Figure"], None]
"""Fills an empty figure."""

Compute = Callable[[Sample], tuple[Outcome, Draw | None]]
"""Does the work of an artefact; returns its outcome, and what draws its picture if it has one."""


@dataclass(frozen=True)
class Texts:
    """What `data/chapter_N.yaml` says of an artefact; in its lists a list is lines that it shares.

    Attributes:
        title: what it shows, in our words.
        file: module of its chapter that computes it.
        settings: sections of the settings that it uses.
        setting: how it is simulated.
        assumptions: what the thesis leaves open, and what we take.
        errata: errors of the thesis that are not in ours, with the equation.
        argument: why it cannot be reproduced, for a verdict that says so.
        printed: numbers of the thesis by name: one each, or several.
        size: of the figure in inches; its shape is kept.
    """

    title: str
    file: str
    settings: tuple[str, ...] = ()
    setting: tuple[Any, ...] = ()
    assumptions: tuple[Any, ...] = ()
    errata: tuple[Any, ...] = ()
    argument: str = ""
    printed: dict[str, Any] = field(default_factory=dict)
    size: tuple[float, float] = (7.0, 4.2)


def chapter_of(name: str) -> int:
    """Return the chapter of an artefact, with which the number in its name begins."""
    return int(name.partition("-")[2][0])


def settings(chapter: int, section: str) -> SimpleNamespace:
    """Return the settings of a section of a chapter, by name; lists are tuples."""
    return SimpleNamespace(**_chapter(chapter)["settings"][section])


@cache
def texts() -> dict[str, Texts]:
    """Return the texts of all artefacts, in the order of the thesis."""
    chapters = [_chapter(number)["artefacts"] for number in _CHAPTERS]
    return {name: Texts(**text) for each in chapters for name, text in each.items()}


@cache
def _chapter(number: int) -> dict[str, Any]:
    text = (DATA / f"chapter_{number}.yaml").read_text(encoding="utf-8")
    return _with_tuples(yaml.safe_load(text))


def _with_tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _with_tuples(each) for key, each in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value
