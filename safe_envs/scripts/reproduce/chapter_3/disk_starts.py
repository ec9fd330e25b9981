"""The starts of Figure 3.1: which of them the theory covers, and what the exact condition does."""

from __future__ import annotations

import math
from collections.abc import Sequence

import sympy as sp

from safe_envs import SafetyProblem
from safe_envs.scripts.reproduce.chapter_3.learned_runs import CHAPTER
from safe_envs.wrappers import HOCBF

_SETTINGS = CHAPTER.settings["disk"]
RATES, PRINTED_START, VALID_START = (_SETTINGS[name] for name in ("rates", "start", "valid_start"))


def by_rate(values: Sequence[float]) -> str:
    """Return a value for each of `RATES`, as text."""
    return ", ".join(f"{value:.3g} (p = {p:g})" for p, value in zip(RATES, values, strict=True))


def chain_at(
    problem: SafetyProblem, p: float, start: Sequence[float]
) -> tuple[float, float, float]:
    """Return h, b_1 and b_2 without the input at a state of the plant.

    Args:
        problem: of the disk.
        p: the rates p_1 = p_2, in 1/s.
        start: the state.
    """
    constraint = HOCBF((p, p)).constraint(problem.plant, problem.barriers[0])
    values = dict(zip(problem.plant.states, map(sp.Float, start), strict=True))
    h, b_1, b_2 = (
        float(problem.plant.numeric(e).subs(values)) for e in (*constraint.chain, constraint.offset)
    )
    return h, b_1, b_2


def outside(problem: SafetyProblem, start: Sequence[float]) -> str:
    """Return whether a start is in C_2 for each gain, in words.

    Args:
        problem: of the disk.
        start: a state.
    """
    values = [chain_at(problem, p, start)[1] for p in RATES]
    where = (
        "outside C_2 for every gain"
        if max(values) < 0
        else "inside C_2 for every gain"
        if min(values) >= 0
        else "inside C_2 for some gains"
    )
    return f"the start {tuple(start)} is {where}: b_1 = {by_rate(values)}, for the true speed"


def crossing(problem: SafetyProblem, p: float, start: Sequence[float]) -> tuple[float, float]:
    """Return when h passes 0, in s, and its minimum while the exact condition binds.

    Then b_1 = b_1(0) exp(-p t) and h = (h(0) + b_1(0) t) exp(-p t), with its minimum
    at t = h(0)/-b_1(0) + 1/p.

    Args:
        problem: of the disk.
        p: the rates p_1 = p_2, in 1/s.
        start: a state.
    """
    h, b_1, _ = chain_at(problem, p, start)
    time = -h / b_1
    return time, b_1 / p * math.exp(-p * time - 1)


def binding(problem: SafetyProblem) -> str:
    """Return what exact derivatives and the control 0 do from the start of the thesis, in words."""
    rows = [chain_at(problem, p, PRINTED_START)[2] for p in RATES]
    times, depths = zip(*[crossing(problem, p, PRINTED_START) for p in RATES], strict=True)
    each = {"violation": rows, "times": times, "depths": depths}
    return CHAPTER.note("figure-3.1", "binding", **{k: by_rate(v) for k, v in each.items()})
