"""Random specifications, and their semantics by definition: over all instants, without progress."""

from __future__ import annotations

import random
from typing import Any

import numpy as np

from safe_envs.filters.specification import Parsed

NAMES = ("safe", "goal")


def satisfied(f: Parsed, word: list[dict[str, bool]], k: int = 0) -> bool:
    """Return whether a trace from instant k meets a formula."""
    if f.operator == "set":
        return word[k][f.name]
    if f.operator == "not":
        return not satisfied(f.parts[0], word, k)
    if f.operator == "and":
        return all(satisfied(part, word, k) for part in f.parts)
    if f.operator == "or":
        return any(satisfied(part, word, k) for part in f.parts)
    if f.operator == "then":
        later = any(satisfied(f.parts[1], word, j) for j in range(k, len(word)))
        return satisfied(f.parts[0], word, k) and later
    first, last = f.window or (0, len(word))
    window = [j for j in range(k + first, k + last + 1) if j < len(word)]
    if f.operator == "always":
        return all(satisfied(f.parts[0], word, j) for j in window)
    if f.operator == "eventually":
        return any(satisfied(f.parts[0], word, j) for j in window)
    return any(
        satisfied(f.parts[1], word, j) and all(satisfied(f.parts[0], word, i) for i in range(k, j))
        for j in window
    )


def robustness(f: Parsed, trace: list[dict[str, float]], k: int = 0) -> float:
    """Return the robustness of a trace from instant k."""
    if f.operator == "set":
        return trace[k][f.name]
    if f.operator == "not":
        return -robustness(f.parts[0], trace, k)
    if f.operator in ("and", "or"):
        return (min if f.operator == "and" else max)(robustness(p, trace, k) for p in f.parts)
    if f.operator == "then":
        later = max(robustness(f.parts[1], trace, j) for j in range(k, len(trace)))
        return min(robustness(f.parts[0], trace, k), later)
    first, last = f.window or (0, len(trace))
    window = [j for j in range(k + first, k + last + 1) if j < len(trace)]
    values: Any = [robustness(f.parts[-1], trace, j) for j in window]
    if f.operator == "always":
        return min(values, default=np.inf)
    if f.operator == "until":
        holds = [[robustness(f.parts[0], trace, i) for i in range(k, j)] for j in window]
        values = [min([value, *hold]) for value, hold in zip(values, holds, strict=True)]
    return max(values, default=-np.inf)


def random_text(draw: random.Random, depth: int, *, outermost: bool = True) -> str:
    """Return a random specification over NAMES, with few and short windows within others."""

    def part(outermost: bool = False) -> str:
        return f"({random_text(draw, depth - 1, outermost=outermost)})"

    def window() -> str:
        longest = 4 if outermost else 1
        first = draw.randint(0, longest)
        return draw.choice(["", f"[{first},{draw.randint(first, longest)}]"])

    kind = draw.choice(["set", "not", "&", "|", "always", "eventually", "until", "then"])
    if depth == 0 or kind == "set":
        return draw.choice(["", "!"]) + draw.choice(NAMES)
    if kind == "not":
        return f"!{part(outermost)}"
    if kind in "&|":
        return f"{part(outermost)} {kind} {part(outermost)}"
    if kind in ("always", "eventually"):
        return f"{kind}{window()} {part()}"
    if kind == "until":
        return f"{part()} until{window()} {part()}"
    return f"{draw.choice(NAMES)} then {part()}"
