"""Thesis Sec. 4.3.1: numbers and claims about the effort in cruise control (Figure 4.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from safe_envs.scripts.reproduce.chapter_4.cruise_setting import CHAPTER, STEP
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number
from safe_envs.scripts.reproduce.framework.paired import is_above

DISTANCES = np.logspace(-3, math.log10(30.0), 181)  # h at which the force is shown, in m
_claim = partial(CHAPTER.claim, "figure-4.1")
_CLOSE, _FAR = 0.25, 1.0  # h below and above which the effort is compared, in m


@dataclass(frozen=True)
class EffortRecord:
    """Episodes as long as each is safe and running: arrays (steps, episodes), NaN afterwards.

    Attributes:
        effort: J = u^2 in N^2.
        acting: the same where the filter changed the action, NaN elsewhere.
        barrier: h before the action, in m.
    """

    effort: np.ndarray
    acting: np.ndarray
    barrier: np.ndarray

    @property
    def peaks(self) -> np.ndarray:
        """Return the largest effort of each episode where the filter acts, or 0."""
        return np.nan_to_num(self.acting).max(axis=0)


EffortRecords = Mapping[str, EffortRecord]
"""By condition, SRCBF and SCBF, with the same noise."""


def outcome_of(runs: EffortRecords, forces: Mapping[str, np.ndarray]) -> Findings:
    """Return numbers and claims of the figure.

    Args:
        runs: of both conditions.
        forces: that both need at each of `DISTANCES`, in N.
    """
    larger, smaller = (
        share_of_time(runs[a], runs[b]) for a, b in (("SRCBF", "SCBF"), ("SCBF", "SRCBF"))
    )
    shares = [
        Number.mean(f"time in which J of SRCBF is the {word} one", 100 * share, "%", 0.0, 100.0)
        for word, share in (("larger", larger), ("smaller", smaller))
    ]
    return Findings(
        [*shares, *(median_peak(name, r.peaks) for name, r in runs.items())],
        [
            claim_on_time(larger, smaller),
            claim_on_edge(forces["SRCBF"]),
            claim_on_bounded(forces["SCBF"]),
            claim_on_total(runs),
            claim_on_peaks(runs["SRCBF"].peaks, runs["SCBF"].peaks),
            claim_on_growth(runs["SRCBF"]),
        ],
    )


def share_of_time(first: EffortRecord, second: EffortRecord) -> np.ndarray:
    """Return the share of the instants in which the first effort is larger, shape (episodes,).

    Instants count as long as both runs are safe and running.

    Args:
        first: one run.
        second: the other, with the same noise.
    """
    both = np.isfinite(first.effort) & np.isfinite(second.effort)
    return (both & (first.effort > second.effort)).sum(axis=0) / np.maximum(both.sum(axis=0), 1)


def median_peak(name: str, peaks: np.ndarray) -> Number:
    """Return the median over episodes of the largest force, with its 95 % order statistics.

    Args:
        name: of the condition.
        peaks: largest effort of each episode, in N^2, shape (episodes,).
    """
    force, count = np.sqrt(np.sort(peaks)), len(peaks)
    reach = math.ceil(0.98 * math.sqrt(count))
    low, high = force[[max(count // 2 - reach - 1, 0), min(count // 2 + reach, count - 1)]].tolist()
    name = f"peak force of {name} where it acts, median"
    return Number(name, float(np.median(force)), low, high, unit="N")


def claim_on_time(larger: np.ndarray, smaller: np.ndarray) -> Claim:
    """Return the claim by the share of time in each episode, so that a few peaks do not decide.

    Args:
        larger: share in which SRCBF's effort is larger, shape (episodes,).
        smaller: share in which it is smaller.
    """
    ahead = Number.mean("", 100 * (larger - smaller), "points", -100.0, 100.0)
    means = {"larger": 100 * larger.mean(), "smaller": 100 * smaller.mean()}
    counts = {"pairs": (larger > smaller).sum(), "count": larger.size}
    return _claim("time", is_above(ahead), **means, **counts)


def claim_on_edge(force: np.ndarray) -> Claim:
    """Return the claim of Sec. 4.2.1 about reciprocal functions, shown by the experiments."""
    power = _power(force)
    return _claim("edge", round(power) < 0, **_growth(power, force))


def claim_on_bounded(force: np.ndarray) -> Claim:
    """Return the claim of a bound, where the thesis calls the SCBF milder."""
    power = _power(force)
    return _claim("bounded", round(power) == 0, **_growth(power, force))


def _power(force: np.ndarray) -> float:
    """Return the power of h with which J goes near the edge."""
    near = DISTANCES < 0.05
    return float(np.polyfit(np.log(DISTANCES[near]), np.log(force[near] ** 2), 1)[0])


def _growth(power: float, force: np.ndarray) -> dict[str, float]:
    return {"power": round(power, 2) + 0.0, "force": abs(force[0]), "h": DISTANCES[0]}


def claim_on_total(runs: EffortRecords) -> Claim:
    """Return the claim by the other reading of a higher effort, which rare peaks decide."""
    both = np.isfinite(runs["SRCBF"].effort) & np.isfinite(runs["SCBF"].effort)
    srcbf, scbf = (
        np.where(both, runs[name].effort, 0.0).sum(axis=0) * STEP for name in ("SRCBF", "SCBF")
    )
    return _claim("total", (srcbf > scbf).mean() > 0.5, **_compared(srcbf, scbf))


def claim_on_peaks(srcbf: np.ndarray, scbf: np.ndarray) -> Claim:
    """Return the claim by our reading of the larger acceleration in the text.

    Args:
        srcbf: largest effort of each episode in N^2, shape (episodes,).
        scbf: the same with the SCBF.
    """
    largest = {"largest": srcbf.max(), "largest_scbf": scbf.max()}
    return _claim("peaks", (srcbf > scbf).mean() > 0.5, **_compared(srcbf, scbf), **largest)


def _compared(srcbf: np.ndarray, scbf: np.ndarray) -> dict[str, float]:
    pairs = {"pairs": (srcbf > scbf).sum(), "count": srcbf.size}
    return {**pairs, "srcbf": np.median(srcbf), "scbf": np.median(scbf)}


def claim_on_growth(srcbf: EffortRecord) -> Claim:
    """Return the claim about the edge in closed loop."""
    acted = np.isfinite(srcbf.acting)
    close, away = (
        srcbf.acting[acted & where] for where in (srcbf.barrier < _CLOSE, srcbf.barrier > _FAR)
    )
    grows = bool(close.size and away.size and np.median(close) > np.median(away))
    each = [
        f"median J {np.median(part):.2g} N^2 {where}" if part.size else f"never {where}"
        for part, where in ((close, f"below h = {_CLOSE} m"), (away, f"above h = {_FAR} m"))
    ]
    return _claim("growth", grows, each=", ".join(each))
