"""The part of a decision's text that makes constraints hold for a whole period."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from safe_envs.wrappers.filter_qp.compiled import change_coefficients, solved_as_cones
from safe_envs.wrappers.filter_qp.decision_text import Body, Values
from safe_envs.wrappers.filter_qp.period_kernel import (
    COEFFICIENTS,
    ENOUGH,
    ROUNDS,
    SLOW,
    constraints_hold,
    end_of_period,
    move_on_line,
)
from safe_envs.wrappers.filter_qp.qp import FilterQP


def write_period(
    body: Body,
    values: Values,
    qp: FilterQP,
    constraints: tuple[Sequence[Sequence[str]], Sequence[str]],
    method: tuple[Callable[..., Any], int],
    counts: Sequence[str],
) -> list[str]:
    """Write how the action moves to where the constraints hold; see `period_search`.

    Args:
        body: receives the statements, which name the arrays of `ArrayDecision`.
        values: receives the formulas.
        qp: the QP.
        constraints: texts of the coefficients and offsets of its k constraints.
        method: kernel that projects the m inputs, and the scratch entries that it needs.
        counts: text of whether each constraint has a meaning; "" where it always has.

    Returns:
        Texts of sums that are to be finite.
    """
    k, m = len(qp.constraints), qp.model.m
    sampled = [i for i, c in enumerate(qp.constraints) if c.change is not None]
    dt, bends, size = body.number(qp.dt), m * (m + 1) // 2, k + len(sampled)
    owners = [*range(k), *sampled]
    body.table("held", [[constraints[1][i], *constraints[0][i], *["0.0"] * bends] for i in owners])
    finite = []
    for place, i in enumerate(sampled, start=k):
        change = values.call(f"filter_change_{i}", change_coefficients(qp, i))
        lines = [f"end_of_period({place}, {dt}, {change}, held)"]
        if counts[i]:
            lines = [f"if {counts[i]}:", *(f"    {line}" for line in lines)]
        body.add(*lines)
        finite.append(" + ".join(f"held[{place}, {e}]" for e in range(1 + m + bends)))
    form = [[f"form[{i}, {e}]" for e in range(3)] for i in range(k)] if solved_as_cones(qp) else []
    body.table("held_form", form + [["0.0"] * 3] * (size - len(form)))
    body.table("slopes", [["0.0"] * m] * size)
    body.table("line", [["0.0"] * COEFFICIENTS] * size)
    body.vector("held_priority", [f"priority[{i}]" for i in owners])
    body.vector("missed", ["0.0"] * size)
    for name in ("held_offsets", "value", "target_margin", "target_active"):
        body.room(name, size)
    body.room("target", m)
    body.room("target_scratch", method[1])
    views = ", ".join(f"vector_view({name}, 0, {m})" for name in ("action", "low", "high", "w"))
    hold = f"constraints_hold({m}, held, held_form, action, slopes, held_offsets, value, missed)"
    body.uses += [end_of_period, constraints_hold, move_on_line, method[0]]
    step = f"move_on_line({m}, held, held_form, low, high, held_priority, action, target, line)"
    axes = [
        f"    if left > {SLOW}:",
        f"        for j in range({m}):",
        *(f"            target[{n}] = action[{n}]" for n in range(m)),
        "            target[j] += 1.0",
        f"            left *= {step}",
    ]
    body.add(
        f"feasible = {hold}",
        f"for _ in range({ROUNDS}):",
        "    if feasible:",
        "        break",
        f"    {method[0].__name__}(slopes, held_offsets, {views}, held_priority, target,"
        " target_margin, target_active, target_scratch)",
        f"    left = {step}",
        *(axes if m > 1 else ()),
        f"    feasible = {hold}",
        f"    if not left < {ENOUGH}:",
        "        break",
    )
    for place, i in enumerate(owners):
        value = f"value[{place}]"
        body.add(
            f"margin[{i}] = {value if place < k else f'min(margin[{i}], {value})'}",
            f"if missed[{place}] > 0.0:",
            f"    active[{i}] = 1.0",
        )
    return finite
