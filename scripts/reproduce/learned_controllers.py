"""What the tables of controllers of chapter 6 share: rates under a learned filter, a printed row and the SCBF that knows the system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from agents.episodes import Totals, run_episodes
from agents.evaluation import Evaluation, evaluate
from agents.policy import make_policy
from agents.repeats import interval_over
from agents.statistics import paired_difference_interval, repeated_interval
from safe_envs.barrier import Barrier
from safe_envs.errors import RelativeDegreeError
from safe_envs.problem import SafetyProblem
from safe_envs.sde import ControlAffineSDE
from safe_envs.vector import SafeVectorEnv
from scripts.reproduce.artefact import Claim, Number
from wrappers import AffineConstraint, Condition, SafetyFilterVectorWrapper
from wrappers.learning import LearnedModel

CLOSE = 5.0
"""Points of the safety rate, up to which two controllers count as close."""

PRINTED_EPISODES = 1000


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


def printed_totals(problem: SafetyProblem, row: Any, episodes: int, seed: int) -> Totals:
    """Run the episodes of an evaluation under a printed row."""
    env = SafetyFilterVectorWrapper(SafeVectorEnv(problem, min(episodes, 1024)), (PrintedRow(row),))
    return run_episodes(env, make_policy("nominal", problem, False), episodes, seed)


def known(problem: SafetyProblem, episodes: int, seed: int) -> Evaluation:
    """Evaluate the SCBF that knows the model."""
    return evaluate(problem, filters=["scbf"], episodes=episodes, seed=seed, bounds=False)


def rate(name: str, found: Evaluation, printed: float | None = None) -> Number:
    """The rate of an evaluation of one filter."""
    return Number.rate(name, found.rows[0]["safe"], found.rows[0]["episodes"], printed, PRINTED_EPISODES if printed is not None else None)


@dataclass(frozen=True)
class Learned:
    """A controller with several identifications, on the episodes of the SCBF that knows the system.

    Attributes:
        rates: with each identification, from 0 to 1.
        episodes: of each.
        difference: mean of the rate less that of the SCBF, in points, with its interval over identifications and episodes.
    """

    rates: list[float]
    episodes: int
    difference: tuple[float, float, float]

    @classmethod
    def run(cls, problem: SafetyProblem, text: str, models: Sequence[LearnedModel], reference: Evaluation) -> Learned:
        """Evaluate a learned filter with each model, on the episodes of a reference."""
        config = reference.config
        how: dict[str, Any] = {"episodes": config["episodes"], "seed": config["seed"], "bounds": False}
        found = [_under(problem, text, model, how) for model in models]
        tables = [next(iter(e.flags.values()))[0].table(reference.flags["scbf"][0]) for e in found]
        mean = np.mean(tables, axis=0).tolist()
        differences = [(first - second) / how["episodes"] for _, first, second, _ in tables]
        ends = repeated_interval(differences, paired_difference_interval(*mean), 0.95, (-1.0, 1.0))
        middle = float(np.mean(differences))
        return cls([e.rows[0]["safety_rate"] for e in found], how["episodes"], (100 * middle, 100 * ends[0], 100 * ends[1]))

    def number(self, name: str, printed: float | None = None) -> Number:
        """The mean rate, with its interval over identifications and episodes."""
        low, high = interval_over(self.rates, self.episodes, 0.95)
        trials = PRINTED_EPISODES if printed is not None else None
        return Number(name, 100 * float(np.mean(self.rates)), 100 * low, 100 * high, printed, trials, "%")

    @property
    def told(self) -> str:
        """The difference and the worst identification, in words."""
        mean, low, high = self.difference
        return f"{mean:+.1f} points [{low:.1f}, {high:.1f}], worst of {len(self.rates)} identifications {100 * min(self.rates):.1f} %"


def _under(problem: SafetyProblem, text: str, model: LearnedModel, how: dict[str, Any]) -> Evaluation:
    """Evaluate a learned filter; the bare env where the input was identified as without any effect, and there is no filter."""
    try:
        return evaluate(problem, filters=[text], learned=[model], **how)
    except RelativeDegreeError:
        return evaluate(problem, filters=["none"], **how)


def close(name: str, each: dict[str, Learned]) -> Claim:
    """That a learned controller is about as safe as the SCBF that knows the system."""
    near = all(abs(learned.difference[0]) <= CLOSE for learned in each.values())
    evidence = "; ".join(f"{place}: {learned.told}" if place else learned.told for place, learned in each.items())
    return Claim(f"{name} is about as safe as the SCBF that knows the system, within {CLOSE:g} points.", near, evidence)
