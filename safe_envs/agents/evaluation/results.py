"""What an evaluation finds, and how long it took."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.attainable import (
    AttainableSafety,
    best_document,
    times_unavoidable,
)
from safe_envs.agents.evaluation.episodes import Trajectories, VisitedStates
from safe_envs.agents.evaluation.rows import EpisodeResults, EvaluationRow
from safe_envs.agents.evaluation.spec import EvaluationSpec
from safe_envs.agents.evaluation.statistics import Comparison, SafeFlags
from safe_envs.agents.jobs.store import package_versions
from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning.models.base import LearnedModel
from safe_envs.problem.problem import SafetyProblem


@dataclass(frozen=True)
class FilterTiming:
    """How long the episodes under a filter took.

    Attributes:
        filter: its name.
        seconds: wall-clock time.
        steps: control periods of all episodes.
        steps_per_second: steps/seconds.
        learning_seconds: mean time of an identification; None where nothing was learned.
        engine: "numpy" or "compiled".
        jobs: processes of NumPy, or threads of the compiled engine.
    """

    filter: str
    seconds: float
    steps: int
    steps_per_second: float
    learning_seconds: float | None
    engine: str
    jobs: int


@dataclass(frozen=True)
class Timing:
    """The part of a result that depends on the machine.

    Attributes:
        num_envs: episodes that NumPy simulates side by side.
        rows: one for each filter.
    """

    num_envs: int
    rows: list[FilterTiming]


@dataclass(frozen=True, repr=False)
class EvaluationData:
    """All that an evaluation finds.

    Attributes:
        problem: what was simulated.
        spec: what was asked for.
        config: all that determines the result, as JSON-able data.
        rows: statistics, one row for each filter.
        comparisons: of every two rows, by which of the same episodes were safe.
        timing: the only part that depends on the machine and on `num_envs`.
        trajectories: of each filter, if they were asked for.
        safe: which episodes are safe, for each filter and identification.
        visited: states of the episodes that contradict a bound, if any do, for each filter and
            identification.
        learned: models of the first identifications.
        is_deterministic: whether nothing is random, so that all episodes are one and the same.
        episodes_if_kept: see `episodes`; None where they were not kept.
        best: how safe any policy can be, counted as the rows are; None where it is not known.
    """

    problem: SafetyProblem
    spec: EvaluationSpec
    config: dict[str, Any]
    rows: list[EvaluationRow]
    comparisons: list[Comparison]
    timing: Timing
    trajectories: dict[str, Trajectories]
    safe: dict[str, list[SafeFlags]]
    visited: dict[str, list[VisitedStates]]
    learned: list[LearnedModel]
    is_deterministic: bool
    episodes_if_kept: dict[str, list[EpisodeResults]] | None
    best: AttainableSafety | None = None

    @property
    def title(self) -> str:
        """How results call what was evaluated."""
        return self.config["title"]

    @property
    def about(self) -> str:
        """Policy, number of episodes, and seed."""
        seed, policy = self.config["seed"], self.config["policy"]["name"]
        return f"policy {policy} | {self.counted} | seed {seed}"

    @property
    def counted(self) -> str:
        """Number of episodes, and of identifications where there are several."""
        repeats = max((row.learning.repeats for row in self.rows if row.learning), default=1)
        often = f" x {repeats} identifications" if repeats > 1 else ""
        count = self.config["episodes"]
        return f"{count} episode{'s' * (count != 1)}{often}"

    @property
    def episodes(self) -> dict[str, list[EpisodeResults]]:
        """Results of each episode, for each filter and identification.

        They are there where the evaluation was to keep them: see `RunSettings.keep_episodes`.

        Raises:
            ConfigurationError: they were not kept.
        """
        if self.episodes_if_kept is None:
            count = sum(len(flags) for each in self.safe.values() for flags in each)
            raise ConfigurationError(
                f"the results of the {count:,} episodes were not kept one by one; evaluate with"
                " keep_episodes=True for that, or with episodes_out='FILE.parquet' to write them"
                " to a file, which takes no memory"
            )
        return self.episodes_if_kept

    def row(self, name: str) -> EvaluationRow:
        """Return the row of a filter.

        Raises:
            KeyError: No row has the name.
        """
        return {row.filter: row for row in self.rows}[name]

    def document(self) -> dict[str, Any]:
        """Return the whole as JSON-able data."""
        return {
            "config": self.config,
            "versions": package_versions(),
            "rows": [row.as_dict() for row in self.rows],
            "comparisons": [asdict(comparison) for comparison in self.comparisons],
            "timing": asdict(self.timing),
            "best": best_document(self.best, self.rows),
        }

    def episode_columns(self) -> dict[str, np.ndarray]:
        """Return the results of all episodes as columns, in the order of filters and episodes.

        Returns:
            Arrays of equal length: filter, identification, episode, safe, return, min_h,
            first_violation (s, NaN where there is none), length (steps), interventions,
            infeasible, effort.

        Raises:
            ConfigurationError: they were not kept: see `episodes`.
        """
        found: dict[str, list[Any]] = {}
        for name, identifications in self.episodes.items():
            for repeat, results in enumerate(identifications):
                columns = results.columns(name, repeat, 0, self.problem.dt)
                for key, values in columns.items():
                    found.setdefault(key, []).append(values)
        return {key: np.concatenate(parts) for key, parts in found.items()}


_NESTED = ("curve", "posterior_bound", "learning", "estimation")


def frame_of(columns: Mapping[str, np.ndarray]) -> Any:
    """Return a pandas DataFrame.

    Args:
        columns: by name, of equal length.

    Raises:
        ConfigurationError: pandas is not installed.
    """
    try:
        import pandas as pd  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigurationError(
            "a data frame needs pandas, which is not installed: pip install pandas, or use rows or"
            " episode_columns()"
        ) from error
    return pd.DataFrame(dict(columns))


def row_columns(evaluation: EvaluationData) -> dict[str, np.ndarray]:
    """Return a result as columns with a row for each filter.

    Args:
        evaluation: to show.

    Returns:
        Arrays of integers, of floats with NaN where there is no number, and of texts: title,
        episodes and statistics of each filter, both bounds, that over a posterior, what is
        attainable, how many times the unavoidable violations there are, and the time it took.
    """
    rows, best = evaluation.rows, evaluation.best
    own = [field for field in fields(EvaluationRow) if field.name not in _NESTED]
    own.sort(key=lambda field: field.name not in ("filter", "policy"))
    columns = {"title": _texts([evaluation.title] * len(rows))}
    for field in own:
        columns[field.name] = _make(str(field.type))([getattr(row, field.name) for row in rows])
    posteriors = [row.posterior_bound for row in rows]
    times = [times_unavoidable(best, row.ci_low, row.ci_high) for row in rows]
    speeds = evaluation.timing.rows
    return columns | {
        "posterior_bound": _floats([each and each.probability for each in posteriors]),
        "posterior_word": _texts([each.word if each else "none" for each in posteriors]),
        "attainable_low": _floats([best and best.lower] * len(rows)),
        "attainable_high": _floats([best and best.upper] * len(rows)),
        "times_unavoidable_low": _floats([each and each.low for each in times]),
        "times_unavoidable_high": _floats([each and each.high for each in times]),
        "learned_from": _wholes([r.learning.transitions if r.learning else 0 for r in rows]),
        "seconds": _floats([speed.seconds for speed in speeds]),
        "steps_per_second": _floats([speed.steps_per_second for speed in speeds]),
    }


def _make(kind: str) -> Callable[[list[Any]], np.ndarray]:
    """Return what makes a column of the values of a field, by its annotation."""
    if any(word in kind for word in ("str", "Word", "Kind")):
        return _texts
    return _wholes if kind == "int" else _floats


def _texts(values: list[Any]) -> np.ndarray:
    return np.array([value or "" for value in values], dtype=object)


def _wholes(values: list[Any]) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def _floats(values: list[Any]) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in values], dtype=float)
