"""The source of an exported promise filter."""

from __future__ import annotations

import numpy as np

from safe_envs.wrappers.export.c_header import MARK
from safe_envs.wrappers.export.c_program import CProgram, wrapped
from safe_envs.wrappers.export.c_source import PREAMBLE
from safe_envs.wrappers.export.interface import Interface
from safe_envs.wrappers.export.kinds import FLOATS, NUMBERS, REAL, TRUTH, VECTOR, WHOLE
from safe_envs.wrappers.value.promise_layout import IN_CHOSEN
from safe_envs.wrappers.value.promise_source import PromiseProgram, PromiseTables

_KINDS = (NUMBERS, NUMBERS, WHOLE, REAL, REAL, REAL, TRUTH)
_ALONG = 12


def promise_source_text(interface: Interface, program: PromiseProgram) -> str:
    """Return filter.c.

    Args:
        interface: of the filter.
        program: what it is written from.

    Raises:
        NotCompilableError: Something in the filter has no form in C.
    """
    symbols = {"x": [q.name for q in interface.states]}
    translated = CProgram(program.source, program.data, interface.precision, symbols, _DOCUMENTED)
    kinds = [*_KINDS, *[FLOATS] * 3, NUMBERS, VECTOR]
    decision = translated.function("promise_decision", kinds)
    given = ("x", "u", "memory->instant", "memory->promise", "memory->expected", "memory->cap")
    given += ("memory->begun", *(f"{t}_table" for t in PromiseTables._fields), "data", "work")
    arguments = ", ".join(a for a, used in zip(given, decision.used, strict=True) if used)
    call = f"promise_decision({arguments})"
    head = wrapped(
        f"""/* {MARK}: a promise filter.
 *
 * {interface.about}
 *
{PREAMBLE}
{translated.text()}
{translated.data_table()}"""
    )
    tables = "\n".join(
        _table(name, doc, values)
        for (name, doc), values in zip(_TABLES, program.tables, strict=True)
    )
    return f"{head}\n{tables}{wrapped(_public(interface, program, call))}"


_TABLES = (
    ("ahead", "Lower bounds of the value on the grid of means, instant by instant."),
    ("above", "Negative upper bounds of it."),
    ("lower", "Lower bounds of the value on the grid of states."),
)

_DOCUMENTED = {
    "promise_coordinates": "Return the coordinates of a state.",
    "promise_barriers": "Return the barriers at a state.",
    "promise_outside": "Return what is positive outside the workspace.",
    "promise_point": "Put the coordinates of a state into the scratch array.",
    "promise_images": "Put into the scratch array where a step leads.",
    "promise_is_safe": "Return whether a state is safe.",
    "promise_has_barriers": "Return whether all barriers of a state are positive.",
    "promise_is_assumed": "Return whether known states are what the tables assume.",
}


def _table(name: str, doc: str, values: np.ndarray) -> str:
    """Return a table as an array of C; its numbers read back exactly."""
    distinct, places = np.unique(values, return_inverse=True)
    digits = np.array([_single(v) for v in distinct.tolist()], dtype=object)[places.ravel()]
    texts = digits.tolist()
    lines = (", ".join(texts[i : i + _ALONG]) for i in range(0, len(texts), _ALONG))
    inner = ",\n".join(lines)
    return f"/* {doc} */\nstatic const float {name}_values[] = {{\n{inner}\n}};\n"


def _single(value: float) -> str:
    digits = f"{value:.9g}"
    return f"{digits}f" if any(c in digits for c in ".e") else digits


def _public(interface: Interface, program: PromiseProgram, call: str) -> str:
    name, macro, number = interface.name, interface.macro, interface.precision.number
    states, inputs = (
        ", ".join(f"input->{part}.{q.name}" for q in quantities)
        for part, quantities in (("state", interface.states), ("proposed", interface.inputs))
    )
    bounds = list(zip(interface.inputs, interface.low, interface.high, strict=True))
    resting = "\n".join(
        f"    result->action.{q.name} = {number(0.5 * low + 0.5 * high)};"
        for q, low, high in bounds
    )
    clipped = "\n".join(
        f"    proposed[{j}] = smaller(larger(proposed[{j}], {number(low)}), {number(high)});"
        for j, (_, low, high) in enumerate(bounds)
    )
    chosen = "\n".join(
        f"    result->action.{q.name} = scratch[{IN_CHOSEN + j}];"
        for j, q in enumerate(interface.inputs)
    )
    tables = "\n".join(
        f"    const floats {t}_table = {{{t}_values, {values.size}}};"
        for t, values in zip(PromiseTables._fields, program.tables, strict=True)
    )
    steps = f"{macro}_STEPS"
    return f"""
/* In a memory that was begun. */
#define BEGUN_KEY 0x50524f4du

/* Return whether all numbers are finite. */
static bool all_finite(const double *values, int size)
{{
    bool finite = true;
    for (int i = 0; i < size; i++) {{
        finite = finite && isfinite(values[i]);
    }}
    return finite;
}}

/* Return whether a memory is one that decisions leave. */
static bool is_sound(const {name}_memory *memory)
{{
    return memory->key == BEGUN_KEY && memory->instant >= 0 && memory->promise >= 0
        && memory->promise <= 1 && memory->cap >= 0
        && (memory->promise > 0 ? memory->expected > 0 : true);
}}

void {name}_begin({name}_memory *memory)
{{
    memory->instant = 0;
    memory->promise = 0;
    memory->expected = 1;
    memory->cap = (double)INFINITY;
    memory->begun = false;
    memory->key = BEGUN_KEY;
}}

/* Promise nothing any more, and fill in what is returned where the filter has no answer. */
static {name}_status refuse({name}_memory *memory, {name}_status status, {name}_result *result)
{{
{resting}
    memory->promise = 0;
    memory->begun = true;
    result->promise = 0;
    result->expected = 0;
    result->replaced = true;
    result->feasible = false;
    result->status = status;
    return status;
}}

{name}_status {name}_decide({name}_memory *memory, const {name}_input *input,
    {name}_result *result)
{{
    const double state[] = {{{states}}};
    double proposed[] = {{{inputs}}};
    if (!is_sound(memory)) {{
        return refuse(memory, {macro}_INVALID_MEMORY, result);
    }}
    const bool finite = all_finite(state, {macro}_STATES) && all_finite(proposed, {macro}_INPUTS);
{clipped}
    double scratch[{interface.scratch}] = {{0}};
    const vector work = {{scratch, {interface.scratch}}};
    const numbers x = {{state, {macro}_STATES}};
    const numbers u = {{proposed, {macro}_INPUTS}};
    const numbers data = {{constants, {program.data.array().size}}};
{tables}
    if (!finite) {{
        memory->instant = smaller_count(memory->instant + 1, {steps});
        return refuse(memory, {macro}_INVALID_INPUT, result);
    }}
    const promise_decision_result found = {call};
    memory->instant = smaller_count(memory->instant, {steps} - 1) + 1;
    if (!isfinite(found.expected) || !isfinite(found.level)
        || !all_finite(scratch + {IN_CHOSEN}, {macro}_INPUTS)) {{
        return refuse(memory, {macro}_UNDEFINED, result);
    }}
    memory->promise = found.level;
    memory->expected = found.expected;
    memory->cap = found.cap;
    memory->begun = true;
{chosen}
    result->promise = found.level;
    result->expected = found.expected;
    result->replaced = found.replaced;
    result->feasible = found.level > 0;
    result->status = {macro}_OK;
    return {macro}_OK;
}}
"""
