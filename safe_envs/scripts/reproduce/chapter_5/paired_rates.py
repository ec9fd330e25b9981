"""Safety rates of several filters on the same episodes, and what pairs of them tell (chapter 5)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from safe_envs.agents.evaluation.comparison import SafetyBits, compare_all
from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.evaluation.repeats import pooled
from safe_envs.scripts.reproduce.framework.artefact import Claim, Number, Sample
from safe_envs.wrappers.learning.models.generator import GeneratorModel

EPISODES = 1000
"""Of each rate in Tables 5.1 and 5.2."""
NO_RATE = 1e-12
"""Rate of a CBF without its class-K term, in 1/s: the derivative of h must not be negative then."""


@dataclass(frozen=True)
class Runs:
    """Episodes under one filter.

    Attributes:
        row: of `evaluate`, over all identifications.
        flags: which episodes were safe, with each identification.
    """

    row: dict[str, Any]
    flags: Sequence[SafetyBits]

    @property
    def rate(self) -> float:
        """In %."""
        return 100 * self.row["safety_rate"]

    @property
    def curve(self) -> dict[str, list[float]]:
        """Rate in % over time in s."""
        return {
            "time": self.row["curve"]["time"],
            "rate": [100 * rate for rate in self.row["curve"]["rate"]],
        }

    def number(self, name: str, printed: float | None = None) -> Number:
        """The rate, beside a printed one of 1000 runs."""
        low, high = (100 * self.row[key] for key in ("ci_low", "ci_high"))
        return Number(
            name, self.rate, low, high, printed, None if printed is None else EPISODES, "%"
        )


@dataclass(frozen=True)
class Difference:
    """Of two rates on the same episodes, in points, with its 95 % interval over identifications and
    episodes."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:+.1f} points [{self.low:.1f}, {self.high:.1f}]"


def measured(
    env_id: str,
    options: dict[str, Any],
    filters: Sequence[str],
    models: Sequence[GeneratorModel],
    sample: Sample,
) -> dict[str, Runs]:
    """Run filters that learn nothing, and the learned one, "ddscbf", with each of several models."""
    how: dict[str, Any] = {
        "options": options,
        "episodes": sample.size(EPISODES),
        "seed": sample.seed,
        "bounds": False,
    }
    found = {name: [evaluate(env_id, filters=[name], **how)] for name in filters}
    if models:
        found["ddscbf"] = [
            evaluate(env_id, filters=["ddscbf"], learned=[model], **how) for model in models
        ]
    return {
        name: Runs(
            pooled([run.rows[0] for run in each], 0.95),
            [flags for run in each for flags in run.flags[name]],
        )
        for name, each in found.items()
    }


def difference(first: Runs, second: Runs) -> Difference:
    """The first rate less the second one, on the same episodes."""
    (found,) = compare_all({"second": second.flags, "first": first.flags}, 0.95)
    return Difference(*(100 * found[key] for key in ("difference", "ci_low", "ci_high")))


def safer(sentence: str, first: Runs, second: Runs, *, printed: bool) -> Claim:
    """Whether the first rate is above the second one by more than chance."""
    apart = difference(first, second)
    return Claim(
        sentence, apart.low > 0.0, f"{first.rate:.1f} % less {second.rate:.1f} %: {apart}", printed
    )


def resolution(first: float, second: float) -> float:
    """What separate samples of the printed size can tell apart with 95 %, in points, by the two
    rates in %."""
    return 196 * math.sqrt(sum(p / 100 * (1 - p / 100) for p in (first, second)) / EPISODES)


def close(runs: dict[str, Runs], scbf: float, ddscbf: float, where: str = "") -> Claim:
    """Whether learning costs less than the print could have told apart, by the two printed rates in
    %: a check of ours."""
    limit, apart = resolution(scbf, ddscbf), difference(runs["ddscbf"], runs["scbf"])
    evidence = (
        f"DDSCBF - SCBF = {apart}, over identifications and episodes; limit {limit:.1f} points,"
        f" what two samples of {EPISODES} tell apart"
    )
    return Claim(
        f"DDSCBF is as safe as SCBF{where}",
        -limit <= apart.low and apart.high <= limit,
        evidence,
        printed=False,
    )


def gap(runs: dict[str, Runs], cbf: str, where: str) -> str:
    """Where the gap between SCBF and CBF comes from."""
    without = runs[f"cbf:alpha={NO_RATE}"]
    return (
        f"{where}, SCBF - CBF is {difference(runs['scbf'], runs[cbf])}: the class-K term (CBF with"
        f" alpha = 0 less CBF) makes {difference(without, runs[cbf])} of it, and the noise part"
        f" (SCBF less CBF with alpha = 0) {difference(runs['scbf'], without)}"
    )
