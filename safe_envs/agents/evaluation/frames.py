"""Results as pandas data frames: a column for each quantity, of one type."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.evaluation_data import EvaluationData
from safe_envs.agents.evaluation.rows import EvaluationRow
from safe_envs.agents.evaluation.yardstick import times_unavoidable
from safe_envs.errors import ConfigurationError

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
