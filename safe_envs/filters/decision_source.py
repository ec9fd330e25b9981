"""The filter as a function of a compiled program."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

from safe_envs.engine.decide import KIND, PLAIN, conclude_single
from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.qp import project_scalar
from safe_envs.engine.slots import Data
from safe_envs.filters.conditions.base import terms_source
from safe_envs.filters.decisions import QPValues
from safe_envs.filters.qp import FilterQP


def unfiltered_source(m: int) -> Source:
    """Return the function `decide` of `safe_envs.engine.slots` that lets every input pass.

    Args:
        m: number of inputs.
    """
    action = "".join(f"u[{j}], " for j in range(m))
    return Source(
        f"def decide(x, u, data, work):\n    return ({action}), u, False, True, (0.0,), 0, True\n"
    )


def filter_source(qp: FilterQP, data: Data, name: str = "decide") -> Source:
    """Return the function `decide` of `safe_envs.engine.slots`, which solves a QP.

    Args:
        qp: the QP.
        data: receives its numbers.
        name: of the function.

    Raises:
        NotCompilableError: Learned terms have no compiled form.
    """
    made, m = QPValues(qp), qp.model.m
    size, barriers = len(made.expressions), len(qp.members)
    # The first entries of `work` are those of learned terms.
    text, lines, given, room = _terms(qp, data)
    starts = [room, *itertools.accumulate([size, m, made.answer, *made.lengths], initial=room)][1:]
    values, u, out, *scratch = starts[:-1]

    def add(part: str, expressions: Iterable[Any]) -> str:
        nonlocal text
        numbers = [qp.model.numeric(e) for e in expressions]
        arguments = {"x": qp.symbols}
        if qp.terms:
            arguments["terms"] = made.symbols[len(qp.symbols) :]
        text += formulas(f"{name}_{part}", arguments, numbers, data)
        return f"{name}_{part}({given}, data)"

    lines.append(f"values = {add('values', made.expressions)}")
    lines += [f"work[{values + i}] = values[{i}]" for i in range(size)]
    for i, (place, levels, demand) in enumerate(made.demands):
        inside = " and ".join(f"values[{level}] > 0.0" for level in levels)
        lines.append(f"if {inside}:")
        lines.append(f"    work[{values + place}] = {add(f'demand_{i}', [demand])}[0]")
    lines += [f"work[{u + j}] = u[{j}]" for j in range(m)]
    shape, weights, ends = (data.add(part) for part in (made.shape, made.weights, made.ends))
    numbers = [1, size, 0, shape, weights, values, u, ends, out, out, out, *scratch]
    k = len(qp.constraints)
    is_scalar = made.shape[KIND] == PLAIN and k == m == 1
    if is_scalar:  # the commonest, without a call of what others need
        lines += [
            f"out = vector_view(work, {out}, 4)",
            "feasible = project_scalar(values[0], values[1], u[0],"
            f" data[{ends}], data[{ends + 1}], out)",
            "code = conclude_single(1, u, feasible, out)",
        ]
    else:
        lines.append(f"code = decide_at(data, work, {data.add(numbers)})")
    slack = "".join(f"work[{out + m + 2 * k + i}], " for i in range(barriers))
    wanted = "".join(f"work[{out + m + 3 * k + j}], " for j in range(m))
    lines += [
        f"chosen = ({''.join(f'work[{out + j}], ' for j in range(m))})",
        f"wanted = {f'({wanted})' if qp.clf is not None else 'u'}",
        f"return chosen, wanted, code > 1, code % 2 == 1, ({slack}), code // 2 - 1, code >= 0",
    ]
    body = "".join(f"    {line}\n" for line in lines)
    uses = (project_scalar, conclude_single) if is_scalar else ()
    return text + Source(f"def {name}(x, u, data, work):\n{body}", uses, starts[-1])


def _terms(qp: FilterQP, data: Data) -> tuple[Source, list[str], str, int]:
    """Return functions of learned terms, lines that name them, arguments, and scratch entries."""
    text, calls = Source(""), []
    # Learned terms are of the state alone.
    state = f"({''.join(f'x[{i}], ' for i in range(qp.model.n))})" if qp.runtime else "x"
    for i, term in enumerate(qp.terms):
        text += terms_source(term, f"filter_terms_{i}", data)
        calls.append(f"filter_terms_{i}({state}, data, work)")
    lines = [f"terms = {' + '.join(calls)}"] if calls else []
    return text, lines, "x, terms" if calls else "x", text.work
