"""Rates of the filters of chapter 5 on the same episodes, and what pairs of them tell."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from safe_envs.scripts.reproduce.framework.artefact import Claim, Workload
from safe_envs.scripts.reproduce.framework.paired import (
    PRINTED_EPISODES,
    MeasuredFilter,
    difference,
    measure,
    with_interval,
)
from safe_envs.scripts.reproduce.framework.thesis_data import chapter
from safe_envs.wrappers.learning.generator import GeneratorModel

CHAPTER = chapter(5)
EPISODES = CHAPTER.settings["learning"]["episodes"]
NO_RATE = 1e-12
"""Rate of a CBF without its class-K term, in 1/s: the derivative of h must not be negative then."""


def measured(
    env_id: str,
    options: dict[str, Any],
    filters: Sequence[str],
    models: Sequence[GeneratorModel],
    sample: Workload,
) -> dict[str, MeasuredFilter]:
    """Return the rates of filters that learn nothing, and of "ddscbf" with several models.

    Args:
        env_id: what to simulate.
        options: arguments of the environment.
        filters: texts of those that learn nothing.
        models: of "ddscbf"; without any it is left out.
        sample: how much is simulated.
    """
    used = {**dict.fromkeys(filters, ()), **({"ddscbf": models} if models else {})}
    size = sample.size(EPISODES), sample.seed
    return {
        text: measure(env_id, text, *size, each, options=options) for text, each in used.items()
    }


def apart(first: MeasuredFilter, second: MeasuredFilter) -> str:
    """Return the first rate less the second one on the same episodes, in words.

    Args:
        first: one filter.
        second: the other.
    """
    return with_interval(difference("", first.flags, second.flags), " points")


def resolution(first: float, second: float) -> float:
    """Return what separate samples of the printed size can tell apart with 95 %, in points.

    Args:
        first: one rate, in per cent.
        second: the other.
    """
    variances = (p / 100 * (1 - p / 100) for p in (first, second))
    return 196 * math.sqrt(sum(variances) / PRINTED_EPISODES)


def close(runs: Mapping[str, MeasuredFilter], scbf: float, ddscbf: float, where: str = "") -> Claim:
    """Return our claim that learning costs less than the thesis could have told apart.

    Args:
        runs: with "scbf" and "ddscbf".
        scbf: printed rate, in per cent.
        ddscbf: printed rate, in per cent.
        where: end of the sentence.
    """
    limit = resolution(scbf, ddscbf)
    gap = difference("", runs["ddscbf"].flags, runs["scbf"].flags)
    within = gap.low is not None and gap.high is not None and max(-gap.low, gap.high) <= limit
    values = {"gap": with_interval(gap, " points"), "limit": limit, "runs": PRINTED_EPISODES}
    return CHAPTER.claim("table-5.1", "close", within, where=where, **values)


def explain_gap(runs: Mapping[str, MeasuredFilter], cbf: str, where: str) -> str:
    """Return where the gap between SCBF and CBF comes from, in words.

    Args:
        runs: with "scbf", the CBF, and the CBF without its class-K term.
        cbf: text of the CBF.
        where: beginning of the sentence.
    """
    without = runs[f"cbf:alpha={NO_RATE}"]
    parts = {"term": apart(without, runs[cbf]), "noise": apart(runs["scbf"], without)}
    gap = apart(runs["scbf"], runs[cbf])
    return CHAPTER.note("table-5.1", "gap", where=where, all=gap, **parts)
