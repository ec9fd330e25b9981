"""What the tables of controllers of chapter 6 share: rates under a learned filter, a printed row
and the SCBF that knows the system."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.agents.evaluation.comparison import pair_counts
from safe_envs.agents.evaluation.evaluate import Evaluation, evaluate
from safe_envs.agents.evaluation.rollout import run_episodes
from safe_envs.agents.evaluation.rows import EpisodeSummary
from safe_envs.agents.evaluation.statistics import (
    paired_difference_interval,
    rate_interval,
    repeated_interval,
)
from safe_envs.agents.policies.registry import make_policy
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import RelativeDegreeError
from safe_envs.problem.barrier import Barrier
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.reproduce.chapter_6.identifications import CONFIDENCE, one_more
from safe_envs.scripts.reproduce.framework.artefact import Claim, Number
from safe_envs.wrappers import AffineConstraint, Condition, SafetyFilterVectorWrapper
from safe_envs.wrappers.learning import LearnedModel

PRINTED_EPISODES = 1000

SIMILAR = 12.0
"""Points between SCBF and Bayesian SCBF, up to which the print calls their rates similar: 55 and 43
% in Table 6.2 (Sec. 7.1)."""

ONE_IDENTIFICATION = (
    "an interval of a rate with identifications holds that with one more of them with 95 %: a"
    " printed rate is with one"
)
"""What the intervals of `Learned.number` are."""


@dataclass(frozen=True)
class PrintedRow(Condition):
    """A row as it is printed.

    Attributes:
        row: an expression of states and inputs, which is to be at least 0.
    """

    row: Any = 0
    name = "printed"
    stochastic = True

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """The row itself."""
        slopes = [sp.diff(self.row, u) for u in model.inputs]
        rest = sp.expand(self.row - sum(a * u for a, u in zip(slopes, model.inputs, strict=True)))
        return AffineConstraint(tuple(slopes), rest, (barrier.expression,))

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> PrintedRow:
        """It has no rates."""
        return cls()


def printed_totals(problem: SafetyProblem, row: Any, episodes: int, seed: int) -> EpisodeSummary:
    """Run the episodes of an evaluation under a printed row."""
    env = SafetyFilterVectorWrapper(SafeVectorEnv(problem, min(episodes, 1024)), (PrintedRow(row),))
    policy = make_policy("nominal", problem, False)
    return run_episodes(env, policy, episodes, seed).summary(CONFIDENCE)


def known(problem: SafetyProblem, episodes: int, seed: int) -> Evaluation:
    """Evaluate the SCBF that knows the model."""
    return evaluate(problem, filters=["scbf"], episodes=episodes, seed=seed, bounds=False)


def rate(name: str, found: Evaluation, printed: float | None = None) -> Number:
    """The rate of an evaluation of one filter."""
    return Number.rate(
        name,
        found.rows[0].safe,
        found.rows[0].episodes,
        printed,
        PRINTED_EPISODES if printed is not None else None,
    )


@dataclass(frozen=True)
class Learned:
    """A controller with several identifications, on the episodes of the SCBF that knows the system.

    Attributes:
        rates: with each identification, from 0 to 1.
        episodes: of each.
        difference: mean of the rate less that of the SCBF, in points, with its interval over
            identifications and episodes.
    """

    rates: list[float]
    episodes: int
    difference: tuple[float, float, float]

    @classmethod
    def run(
        cls,
        problem: SafetyProblem,
        text: str,
        models: Sequence[LearnedModel],
        reference: Evaluation,
    ) -> Learned:
        """Evaluate a learned filter with each model, on the episodes of a reference."""
        config = reference.config
        how: dict[str, Any] = {
            "episodes": config["episodes"],
            "seed": config["seed"],
            "bounds": False,
        }
        found = [_under(problem, text, model, how) for model in models]
        known = reference.episodes["scbf"][0].safe
        tables = [pair_counts(next(iter(e.episodes.values()))[0].safe, known) for e in found]
        mean = np.mean(tables, axis=0).tolist()
        differences = [(first - second) / how["episodes"] for _, first, second, _ in tables]
        ends = repeated_interval(
            differences, paired_difference_interval(*mean), CONFIDENCE, (-1.0, 1.0)
        )
        middle = float(np.mean(differences))
        return cls(
            [e.rows[0].safety_rate for e in found],
            how["episodes"],
            (100 * middle, 100 * ends[0], 100 * ends[1]),
        )

    def number(self, name: str, printed: float | None = None) -> Number:
        """The mean rate, and the interval of the rate with one more identification: a printed one
        is with a single one.

        The distances from the mean to the ends of the interval over episodes, which all
        identifications share, and those of the prediction interval over identifications are added
        as squares.
        """
        mean = float(np.mean(self.rates))
        low, high = rate_interval(round(mean * self.episodes), self.episodes, CONFIDENCE)
        half = mean - one_more(self.rates)[0]
        low, high = (
            max(mean - math.hypot(mean - low, half), 0.0),
            min(mean + math.hypot(high - mean, half), 1.0),
        )
        trials = PRINTED_EPISODES if printed is not None else None
        return Number(name, 100 * mean, 100 * low, 100 * high, printed, trials, "%")

    @property
    def told(self) -> str:
        """The mean difference and the rates, in words."""
        mean, low, high = self.difference
        rates = f"{100 * min(self.rates):.1f} to {100 * max(self.rates):.1f} %"
        return (
            f"{mean:+.1f} points [{low:.1f}, {high:.1f}] on average over {len(self.rates)}"
            f" identifications, with rates of {rates}"
        )


def _under(
    problem: SafetyProblem, text: str, model: LearnedModel, how: dict[str, Any]
) -> Evaluation:
    """Evaluate a learned filter; the bare env where the input was identified as without any effect,
    and there is no filter."""
    try:
        return evaluate(problem, filters=[text], learned=[model], **how)
    except RelativeDegreeError:
        return evaluate(problem, filters=["none"], **how)


def similar(each: dict[str, Learned]) -> Claim:
    """That an identified system is as safe as the real one, by the interval of the mean difference
    at each start.

    Source: thesis Sec. 7.1, which gives no number: the largest printed difference is taken for the
        limit.
    """
    near = all(
        learned.difference[1] >= -SIMILAR and learned.difference[2] <= SIMILAR
        for learned in each.values()
    )
    evidence = "; ".join(
        f"{place}: {learned.told}" if place else learned.told for place, learned in each.items()
    )
    return Claim(
        f"The learned system has a safety ratio similar to the real one's: up to {SIMILAR:g} points"
        " apart, as in print.",
        near,
        evidence,
    )
