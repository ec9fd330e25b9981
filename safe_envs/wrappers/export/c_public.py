"""The functions of an exported filter that others call."""

from __future__ import annotations

import math

from safe_envs.wrappers.export.decision import FilterProgram
from safe_envs.wrappers.export.interface import Interface
from safe_envs.wrappers.filter_qp.limits import WIDEST

_SIGNS = {
    "positive": ">",
    "nonnegative": ">=",
    "negative": "<",
    "nonpositive": "<=",
    "nonzero": "!=",
}


def public_functions(
    interface: Interface, program: FilterProgram, call: str, barrier: str, needs_data: bool
) -> str:
    """Return the functions that the header declares.

    Args:
        interface: of the filter.
        program: what it is written from.
        call: text of the call of its decision.
        barrier: text of the call of its barriers.
        needs_data: whether functions read constants by their place.
    """
    name, macro, real = interface.name, interface.macro, interface.precision.type
    number = interface.precision.number
    entries = [f"input->state.{q.name}" for q in interface.states]
    entries += [f"input->runtime.{q.name}" for q in interface.runtime]
    vectors = {
        "state_values": entries,
        **{
            f"{part}_values": [f"input->{part}.{q.name}" for q in interface.inputs]
            for part in ("proposed", "low", "high")
        },
    }
    size = len(entries)
    arrays = "\n".join(
        f"    {'const ' * (v in ('state_values', 'proposed_values'))}{real} {v}[] ="
        f" {{{', '.join(e)}}};"
        for v, e in vectors.items()
    )
    defaults = "\n".join(
        f"    input->{part}.{q.name} = {number(_end(value))};"
        for part, values in (("low", interface.low), ("high", interface.high))
        for q, value in zip(interface.inputs, values, strict=True)
    )
    clear = "\n".join(
        f"    input->{group}.{q.name} = {number(q.default) if q.default else 0};"
        for group, quantities in (
            ("state", interface.states),
            ("runtime", interface.runtime),
            ("proposed", interface.inputs),
        )
        for q in quantities
    )
    resting = "\n".join(
        f"    result->action.{q.name} = resting(input->low.{q.name}, input->high.{q.name});"
        for q in interface.inputs
    )
    signs = "".join(
        f" || !(input->runtime.{q.name} {_SIGNS[q.sign]} 0)" for q in interface.runtime if q.sign
    )
    clipped = "\n".join(
        f"    {part}_values[j] = {part}_values[j] < -WIDEST ? -WIDEST"
        f" : {part}_values[j] > WIDEST ? WIDEST : {part}_values[j];"
        for part in ("low", "high")
    )
    pursued = "\n".join(
        f"    result->pursued.{q.name} = input->proposed.{q.name};" for q in interface.inputs
    )
    chosen = "\n".join(
        f"    result->action.{q.name} = found.chosen.at[{j}];\n"
        f"    result->pursued.{q.name} = found.pursued.at[{j}];"
        for j, q in enumerate(interface.inputs)
    )
    data = f"    const numbers data = {{constants, {program.data.array().size}}};\n" * needs_data
    nan = number(float("nan"))
    everywhere = [i for i in range(len(interface.constraints)) if i not in program.partial]
    overflows = "".join(f" || !isfinite(barrier.at[{i}])" for i in everywhere)
    bounded = "true"
    if not interface.endless:
        ends = [f"all_finite({part}_values, {macro}_INPUTS)" for part in ("low", "high")]
        bounded = " && ".join(ends)
    return f"""
/* Return whether all numbers are finite. */
static bool all_finite(const {real} *values, int size)
{{
    bool finite = true;
    for (int i = 0; i < size; i++) {{
        finite = finite && isfinite(values[i]);
    }}
    return finite;
}}

/* In place of an infinite input bound. */
static const {real} WIDEST = {number(interface.precision.tolerance(WIDEST))};

/* Return the middle of an interval; 0, or the end next to it, where an end is infinite. */
static {real} resting({real} low, {real} high)
{{
    if (low > -WIDEST && high < WIDEST) {{
        return {number(0.5)} * low + {number(0.5)} * high;
    }}
    return low > 0 ? low : high < 0 ? high : 0;
}}

void {name}_defaults({name}_input *input)
{{
{clear}
{defaults}
}}

/* Fill in what is returned where the filter has no answer. */
static {name}_status refuse(const {name}_input *input, {name}_status status, {name}_result *result)
{{
{resting}
{pursued}
    for (int i = 0; i < {macro}_CONSTRAINTS; i++) {{
        result->barrier[i] = {nan};
        result->margin[i] = {nan};
        result->slack[i] = {nan};
        result->active[i] = false;
    }}
    result->feasible = false;
    result->cause = -1;
    result->status = status;
    return status;
}}

{name}_status {name}_decide(const {name}_input *input, {name}_result *result)
{{
{arrays}
    const numbers x = {{state_values, {size}}};
    const numbers u = {{proposed_values, {macro}_INPUTS}};
    const numbers low = {{low_values, {macro}_INPUTS}};
    const numbers high = {{high_values, {macro}_INPUTS}};
    bool bounded = {bounded};
    for (int j = 0; j < {macro}_INPUTS; j++) {{
        bounded = bounded && low_values[j] <= high_values[j] && low_values[j] <= WIDEST
            && high_values[j] >= -WIDEST;
    {clipped}
    }}
    if (!bounded) {{
        {name}_input other = *input;
        {name}_defaults(&other);
        other.proposed = input->proposed;
        return refuse(&other, {macro}_INVALID_BOUNDS, result);
    }}
    if (!all_finite(state_values, {size}) || !all_finite(proposed_values, {macro}_INPUTS){signs}) {{
        return refuse(input, {macro}_INVALID_INPUT, result);
    }}
    {real} scratch[{max(interface.scratch, 1)}] = {{0}};
    const vector work = {{scratch, {max(interface.scratch, 1)}}};
{data}    const decide_result found = {call};
    const numbers_{len(interface.constraints)} barrier = {barrier};
    if (!found.sound{overflows}) {{
        return refuse(input, {macro}_UNDEFINED, result);
    }}
{chosen}
    bool acts = false;
    for (int i = 0; i < {macro}_CONSTRAINTS; i++) {{
        result->barrier[i] = isfinite(barrier.at[i]) ? barrier.at[i] : ({real})-INFINITY;
        result->margin[i] = found.reached.at[i];
        result->slack[i] = found.slack.at[i];
        result->active[i] = found.acting.at[i] > 0;
        acts = acts || result->active[i];
    }}
    result->feasible = found.feasible;
    result->cause = acts ? found.cause : -1;
    result->status = {macro}_OK;
    return {macro}_OK;
}}
"""


def _end(value: float) -> float:
    """Return an input bound, infinite where there is none."""
    return math.copysign(math.inf, value) if abs(value) >= WIDEST else value
