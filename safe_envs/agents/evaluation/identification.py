"""The models of learned filters: from files, or learned first, once or in several repeats."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.rows import EpisodeSummary, LearningSummary
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.evaluation.statistics import Curve, rate_interval, repeated_interval
from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.filters.conditions.base import Condition
from safe_envs.filters.conditions.registry import LEARNED
from safe_envs.filters.conditions.syntax import learned_parts
from safe_envs.filters.conditions.text import parse_conditions
from safe_envs.filters.learning import learner_of, load_learned
from safe_envs.filters.learning.models.base import LearnedModel
from safe_envs.problem.problem import SafetyProblem


class Learning:
    """Learns the models of filters, each once.

    Args:
        problem: what is learned, with the defaults of each method.
        names: texts of the filters.
        given: models, or files of `safe-envs identify`, that are used in place of learning.
        repeats: how often to learn, each time with another seed.
        seed: of the first time; the others have children of it.

    Raises:
        ConfigurationError: A file does not fit or no filter uses it, two models are of one method,
            or the number of repeats is not allowed, or more than 1 without anything to learn.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        names: Sequence[str],
        given: Iterable[LearnedModel | Path | str],
        repeats: int,
        seed: int,
    ) -> None:
        require_whole("repeats", repeats, 1)
        self._problem, self._repeats, self._seed = problem, repeats, seed
        self._methods = list(dict.fromkeys(method for name in names for method in _methods(name)))
        self._given: dict[str, LearnedModel] = {}
        for entry in given:
            model = entry if isinstance(entry, LearnedModel) else load_learned(entry, problem)
            if model.method in self._given:
                raise ConfigurationError(
                    f"two learned models of the method {model.method} were given; give one of each"
                )
            if model.method not in self._methods:
                what = type(model).__name__ if isinstance(entry, LearnedModel) else entry
                raise ConfigurationError(
                    f"{what} holds {model.method}, which no filter uses; add"
                    f" {_filter_of(model.method)} or leave it out"
                )
            type(model).check(model.signature, problem)
            self._given[model.method] = model
        self._learned: dict[tuple[str, int], LearnedModel] = {}
        if repeats > 1 and not self.missing():
            raise ConfigurationError(
                f"repeats = {repeats}, but nothing is learned: no filter needs it, or its file was"
                " given"
            )

    def repeats(self, name: str) -> int:
        """Return how many identifications a filter is evaluated with."""
        return self._repeats if any(method not in self._given for method in _methods(name)) else 1

    def missing(self) -> list[tuple[str, int]]:
        """Return what has yet to be learned: methods, and the number of the repeat."""
        needed = [
            (method, r)
            for method in self._methods
            if method not in self._given
            for r in range(self._repeats)
        ]
        return [each for each in needed if each not in self._learned]

    def learn(self, method: str, repeat: int, progress: Progress | None) -> None:
        """Learn by a method, with the seed of a repeat; its warnings are in the record.

        Args:
            method: its name.
            repeat: number of the repeat.
            progress: called with the part that is done.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            self._learned[method, repeat] = learner_of(method)(
                self._problem, seed=self._child(repeat), progress=progress
            )

    def conditions(self, name: str, repeat: int) -> tuple[Condition, ...]:
        """Return the conditions of a filter, with what was learned in a repeat.

        Args:
            name: text of the filter.
            repeat: number of the repeat.

        Raises:
            ConfigurationError: The text of the filter cannot be read.
        """
        models = {
            method: self._given.get(method) or self._learned[method, repeat]
            for method in _methods(name)
        }
        return parse_conditions(name, self._problem, models)

    def models(self) -> list[LearnedModel]:
        """Return the models of the first identifications, each once."""
        return [self._given.get(method) or self._learned[method, 0] for method in self._methods]

    def _child(self, repeat: int) -> int:
        if repeat == 0:
            return self._seed
        # Episodes have keys of one entry.
        return int(np.random.SeedSequence(self._seed, spawn_key=(repeat, 0)).generate_state(1)[0])


def _methods(name: str) -> list[str]:
    """Return the methods of the models that a filter needs without naming their files."""
    return [method for method, file in learned_parts(name) if file is None]


def _filter_of(method: str) -> str:
    return next(name for name, condition in LEARNED.items() if condition.method == method)


def learned_of(conditions: Sequence[Condition]) -> list[LearnedModel]:
    """Return the learned models that conditions need, each once."""
    return list({id(m): m for c in conditions for m in c.learned_models}.values())


def seconds_of(identifications: Sequence[Sequence[Condition]]) -> float | None:
    """Return the mean time of an identification in s; None where nothing was learned."""
    models = [model for conditions in identifications for model in learned_of(conditions)]
    return sum(model.record.seconds for model in models) / len(identifications) if models else None


def describe(
    identifications: Sequence[Sequence[Condition]],
    rates: Sequence[float],
    problem: SafetyProblem,
    knowledge: str,
) -> LearningSummary | None:
    """Return what was learned for a filter, its cost, and the rate with each identification.

    Args:
        identifications: the conditions of the filter, with each identification.
        rates: safety rate with each.
        problem: what is simulated.
        knowledge: of the filter, "model" or "plant".

    Returns:
        None where nothing was learned.
    """
    models = [model for conditions in identifications for model in learned_of(conditions)]
    if not models:
        return None
    records = [model.record for model in models]
    return LearningSummary(
        methods=sorted({model.method for model in models}),
        repeats=len(identifications),
        transitions=sum(record.transitions for record in records) // len(identifications),
        seeds=[record.seed for record in records],
        sha256=[model.sha256 for model in models],
        files=sorted({str(model.path) for model in models if model.path is not None}),
        errors=(
            {
                name: float(np.mean([record.errors[name] for record in records]))
                for name in records[0].errors
            }
            if len({tuple(record.errors) for record in records}) == 1
            else {}
        ),
        # Those of other identifications differ in their figures only.
        warnings=list(
            {
                re.sub(r"[\d.e+-]+", "#", text): text
                for record in reversed(records)
                for text in record.warnings
            }.values()
        ),
        remarks=_remarks(identifications[0], problem, knowledge),
        rates=list(rates),
    )


def _remarks(conditions: Sequence[Condition], problem: SafetyProblem, knowledge: str) -> list[str]:
    """Return what the heading of an evaluation does not say: where the data came from, for one."""
    differing = dict.fromkeys(
        ", ".join(model.signature.differences(problem)) for model in learned_of(conditions)
    )
    elsewhere = [f"it was learned from a plant with {text}" for text in differing if text]
    corrects = knowledge == "plant" and any(condition.corrects_model for condition in conditions)
    return [
        *elsewhere,
        *(
            ["it starts from the model, which it corrects, and does not know the plant"]
            if corrects
            else []
        ),
    ]


_MEANS = (
    "min_h_median",
    "min_h_p05",
    "intervention_rate",
    "infeasible_rate",
    "effort_mean",
    "return_mean",
)
_SUMS = ("episodes", "safe", "violations", "touching", "below_rounding")


def pooled(summaries: Sequence[EpisodeSummary], confidence: float) -> EpisodeSummary:
    """Return several identifications on the same episodes as one: sums, means, and intervals.

    Args:
        summaries: one for each identification.
        confidence: of the intervals, which are over identifications and episodes.
    """
    first = summaries[0]
    if len(summaries) == 1:
        return first
    rates = [each.safety_rate for each in summaries]
    low, high = interval_over(rates, first.episodes, confidence)
    sums: dict[str, Any] = {key: sum(getattr(s, key) for s in summaries) for key in _SUMS}
    means: dict[str, Any] = {key: _mean([getattr(s, key) for s in summaries]) for key in _MEANS}
    return EpisodeSummary(
        **sums,
        **means,
        worst_below_rounding=max(each.worst_below_rounding for each in summaries),
        safety_rate=math.fsum(rates) / len(rates),
        ci_low=low,
        ci_high=high,
        curve=_curve([each.curve for each in summaries], first.episodes, confidence),
    )


def interval_over(rates: Sequence[float], episodes: int, confidence: float) -> tuple[float, float]:
    """Return the interval of the mean rate of identifications evaluated on the same episodes.

    Args:
        rates: one for each identification.
        episodes: number of the episodes.
        confidence: of the interval.
    """
    mean = math.fsum(rates) / len(rates)
    safe = round(mean * episodes)
    return repeated_interval(
        rates, rate_interval(safe, episodes, confidence), confidence, (0.0, 1.0)
    )


def _curve(curves: Sequence[Curve], episodes: int, confidence: float) -> Curve:
    rates = np.array([curve.rate for curve in curves])
    intervals = [interval_over(column.tolist(), episodes, confidence) for column in rates.T]
    return Curve(
        curves[0].time,
        np.sum([curve.safe for curve in curves], axis=0).tolist(),
        rates.mean(axis=0).tolist(),
        [low for low, _ in intervals],
        [high for _, high in intervals],
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None
