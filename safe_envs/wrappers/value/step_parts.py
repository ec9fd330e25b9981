"""A step in parts: what inputs move in proportion, noise of constant size, and the rest."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import sympy as sp

from safe_envs.wrappers.value.reduction import ReducedProblem

_PARTS = {1: 8, 2: 4}
_FEW_PARTS = 2
"""Parts of the interval of each uncertain parameter, by the number of parameters."""


@dataclass(frozen=True)
class StepParts:
    """A step in parts: x' = rest + effect u + blur w.

    Attributes:
        rest: of each coordinate, with the boxed noise.
        effect: of each coordinate and input.
        blur: standard deviation along each coordinate of noise that is integrated exactly.
        boxed: normals that are divided into boxes.
        is_affine: whether `rest` does not hold the inputs.
    """

    rest: tuple[sp.Expr, ...]
    effect: tuple[tuple[sp.Expr, ...], ...]
    blur: tuple[float, ...]
    boxed: tuple[sp.Symbol, ...]
    is_affine: bool

    @property
    def expressions(self) -> list[sp.Expr]:
        """All expressions of the step."""
        return [*self.rest, *(entry for effects in self.effect for entry in effects)]


def step_parts(reduced: ReducedProblem) -> StepParts:
    """Return the step of a problem in parts."""
    rest = [sp.sympify(e) for e in reduced.step]
    blur, boxed = [0.0] * len(rest), []
    for w in reduced.noise:
        sizes = [sp.diff(e, w) for e in rest]
        touched = [i for i, size in enumerate(sizes) if size != 0]
        if len(touched) == 1 and sizes[touched[0]].is_number and not blur[touched[0]]:
            i = touched[0]
            blur[i] = abs(float(sizes[i]))
            rest[i] = rest[i].subs(w, 0)
        elif touched:
            boxed.append(w)
    inputs = reduced.inputs
    varying = {*inputs, *boxed}
    effect = [[sp.diff(e, u) for u in inputs] for e in rest]
    is_affine = not any(entry.free_symbols & varying for row in effect for entry in row)
    if is_affine:
        rest = [e.subs(dict.fromkeys(inputs, 0)) for e in rest]
    else:
        effect = [[sp.Integer(0)] * len(inputs) for _ in rest]
    return StepParts(tuple(rest), tuple(map(tuple, effect)), tuple(blur), tuple(boxed), is_affine)


def scenarios(
    intervals: Mapping[sp.Symbol, tuple[float, float]],
) -> list[tuple[tuple[float, float], ...]]:
    """Return boxes that cover uncertain parameters.

    Args:
        intervals: (low, high) of each parameter.
    """
    parts = _PARTS.get(len(intervals), _FEW_PARTS)
    cut = []
    for low, high in intervals.values():
        number = parts if high > low else 1
        ends = [low + (high - low) * i / number for i in range(number)] + [high]
        cut.append(list(itertools.pairwise(ends)))
    return list(itertools.product(*cut))
