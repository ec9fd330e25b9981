"""The texts of an exported filter: header, decision, build file and README."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import sympy as sp

from safe_envs.dynamics.symbols import declared_sign
from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.slots import Data
from safe_envs.errors import ConfigurationError, shown
from safe_envs.export.c_expressions import NUMBERS, VECTOR, Precision, c_name, c_names, comment
from safe_envs.export.c_statements import CProgram, wrapped
from safe_envs.filters.arguments import WIDEST, takes_endless
from safe_envs.filters.conditions.text import spec_of
from safe_envs.filters.decision_kernel import furthest_constraint
from safe_envs.filters.decision_source import ArrayDecision, Body
from safe_envs.filters.qp import FilterQP
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.signals import TIME


@dataclass(frozen=True)
class Quantity:
    """A number that goes in or comes out.

    Attributes:
        name: in C.
        symbol: as the model calls it.
        unit: its unit, "" where none is known.
        sign: "positive", "nonnegative", "negative", "nonpositive" or "nonzero" where the model
            relies on that of a measured quantity.
        default: its value where none is given.
    """

    name: str
    symbol: str
    unit: str
    sign: str = ""
    default: float = 0.0

    @property
    def described(self) -> str:
        """The symbol and the unit, for a comment."""
        unit = f", in {self.unit}" * bool(self.unit)
        return comment(f"{self.symbol}{unit}{f', {self.sign}' * bool(self.sign)}")


@dataclass(frozen=True)
class Interface:
    """The interface of an exported filter.

    Attributes:
        name: with which all public names of C begin.
        title: what the filter is, in one line: its full text, as for `--filter`.
        precision: of its numbers.
        states: n states, in the order of the model.
        runtime: quantities that are measured at run time.
        inputs: m inputs.
        constraints: names of C of the k constraints.
        barriers: names of their barriers.
        formulas: h of each barrier.
        low: lower input bounds, if nothing else is known.
        high: upper ones.
        proposes: whether the filter pursues a goal, in place of the proposed input.
        endless: whether input bounds may be infinite.
        scratch: numbers on the stack.
    """

    name: str
    title: str
    precision: Precision
    states: tuple[Quantity, ...]
    runtime: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    constraints: tuple[str, ...]
    barriers: tuple[str, ...]
    formulas: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    proposes: bool
    endless: bool
    scratch: int

    @property
    def macro(self) -> str:
        """The name in capitals."""
        return self.name.upper()

    @property
    def about(self) -> str:
        """What the filter is and keeps, for the comment at the head of a file."""
        lines = [self.title, "Barriers, safe where none is negative:"]
        lines += [
            f"{comment(name)} = {comment(h)}"
            for name, h in zip(self.barriers, self.formulas, strict=True)
        ]
        return "\n * ".join(lines)


def interface_of(
    safety_filter: SafetyFilter,
    name: str,
    precision: Precision,
    units: Mapping[str, str],
    scratch: int,
) -> Interface:
    """Return the interface of a filter.

    Args:
        safety_filter: the filter.
        name: with which all public names of C begin.
        precision: of its numbers.
        units: of states, inputs and other quantities, by symbol.
        scratch: numbers that it needs on the stack.

    Raises:
        ConfigurationError: The name is no name of C.
    """
    require_name(name)
    qp, model = safety_filter.qp, safety_filter.model
    quantities = quantities_of(qp.symbols, {TIME.name: "s", **units}, model.parameters)
    names = [barrier.name for barrier, _ in safety_filter.pairs]
    of_condition: dict[str, list[str]] = {}
    for barrier, condition in safety_filter.pairs:
        of_condition.setdefault(spec_of(condition), []).append(barrier.name)
    title = "; ".join(f"{c} for {', '.join(each)}" for c, each in of_condition.items())
    goal = "" if qp.clf is None else f"; goal V = {formula_text(qp.model.numeric(qp.clf.V))}"
    return Interface(
        name,
        comment(title + goal),
        precision,
        quantities[: model.n],
        quantities[model.n :],
        quantities_of(model.inputs, units, {}),
        tuple(c_names(names)),
        tuple(names),
        tuple(formula_text(barrier.expression) for barrier, _ in safety_filter.pairs),
        tuple(qp.low),
        tuple(qp.high),
        qp.clf is not None,
        takes_endless(qp.constraints, qp.clf),
        scratch,
    )


def formula_text(expression: sp.Expr) -> str:
    """Return an expression as text, without zeros at the end of numbers."""
    return sp.sstr(expression, full_prec=False)


def require_name(name: str) -> None:
    """Raise ConfigurationError where public names of C cannot begin with a name."""
    if c_name(name) != name or not name.isidentifier():
        raise ConfigurationError(
            f"name = {shown(name)} is no name of C; give letters, digits and _, no keyword"
        )


def quantities_of(
    symbols: Sequence[sp.Symbol], units: Mapping[str, str], defaults: Mapping[sp.Symbol, float]
) -> tuple[Quantity, ...]:
    """Return quantities, with their names in C.

    Args:
        symbols: of them.
        units: by symbol.
        defaults: their values where none are given, by symbol.
    """
    return tuple(
        Quantity(
            name,
            symbol.name,
            units.get(symbol.name, ""),
            (declared_sign(symbol) or "").replace("real", ""),
            float(defaults.get(symbol, 0.0)),
        )
        for name, symbol in zip(c_names(s.name for s in symbols), symbols, strict=True)
    )


MARK = "Generated by safe-envs export"
"""With this the first line of every exported file begins, after what begins a comment."""

STATUSES = (
    ("OK", "the action is that of the filter"),
    ("INVALID_BOUNDS", "a lower input bound is above its upper one, or one is not allowed"),
    ("INVALID_INPUT", "a state, a measured quantity or the proposed input is not allowed"),
    ("UNDEFINED", "a constraint, the goal or a barrier has no finite value at this state"),
)
"""Status codes, in their order, and what they mean."""


def header_text(interface: Interface) -> str:
    """Return filter.h."""
    name, macro, real = interface.name, interface.macro, interface.precision.type
    k, m = len(interface.constraints), len(interface.inputs)
    runtime = struct_text(
        f"{name}_runtime", "Quantities measured at run time.", interface.runtime, real
    )
    statuses = "\n".join(
        f"    {macro}_{word} = {i}, /* {meaning} */" for i, (word, meaning) in enumerate(STATUSES)
    )
    constraints = "\n".join(
        f"    {macro}_CONSTRAINT_{own} = {i}, /* {comment(barrier)} */"
        for i, (own, barrier) in enumerate(
            zip(interface.constraints, interface.barriers, strict=True)
        )
    )
    of_runtime = f"    {name}_runtime runtime;\n" if interface.runtime else ""
    endless = ", or -INFINITY" if interface.endless else ", finite"
    proposed = (
        "without effect: the filter pursues a goal" if interface.proposes else "to be filtered"
    )
    return wrapped(
        f"""/* {MARK}: the interface of a safety filter.
 *
 * {interface.about}
 */
#ifndef {macro}_FILTER_H
#define {macro}_FILTER_H

#include <stdbool.h>

#ifdef __cplusplus
extern "C" {{
#endif

/* Numbers of states, of inputs and of constraints. */
#define {macro}_STATES {len(interface.states)}
#define {macro}_INPUTS {m}
#define {macro}_CONSTRAINTS {k}

/* Constraints, in the order of all arrays of them. */
typedef enum {{
{constraints}
}} {name}_constraint;

/* What became of a call. */
typedef enum {{
{statuses}
}} {name}_status;

{struct_text(f"{name}_state", "A state.", interface.states, real)}
{runtime}
{struct_text(f"{name}_inputs", "An input.", interface.inputs, real)}
/* What the filter is given. */
typedef struct {{
    {name}_state state;
{of_runtime}    {name}_inputs proposed; /* input, {proposed} */
    {name}_inputs low; /* lower bounds of the actuators at this moment{endless} */
    {name}_inputs high; /* upper bounds; where both are equal, the input is held */
}} {name}_input;

/* What the filter decides. Where the status is not {macro}_OK, the action is the middle of the
 * input bounds (of those in {name}_defaults, if the given ones are invalid), feasible is false,
 * nothing is active, and margin, slack and barrier are NaN.
 */
typedef struct {{
    {name}_inputs action; /* input to be executed, always inside its bounds */
    {name}_inputs pursued; /* the proposed input{", or that of the goal" * interface.proposes} */
    {real} barrier[{macro}_CONSTRAINTS]; /* safe where not negative; -INFINITY without a value */
    {real} margin[{macro}_CONSTRAINTS]; /* of each constraint at the action */
    {real} slack[{macro}_CONSTRAINTS]; /* by how much the action violates each, if not feasible */
    bool active[{macro}_CONSTRAINTS]; /* constraints that bind or cannot be met */
    bool feasible; /* whether some input within its bounds meets all constraints */
    int cause; /* the active constraint that is furthest from the proposed input; -1 for none */
    {name}_status status;
}} {name}_result;

/* Set the input bounds for which the filter was made, and all else to 0. */
void {name}_defaults({name}_input *input);

/* Choose the input nearest to the proposed one that all constraints allow; where they cannot be met
 * together, the nearest of the least-violating ones. Nothing is allocated or kept between calls, so
 * that any number of threads may call it. It needs about {_stack(interface)} bytes of stack.
 */
{name}_status {name}_decide(const {name}_input *input, {name}_result *result);

#ifdef __cplusplus
}}
#endif

#endif
"""
    )


def _stack(interface: Interface) -> int:
    """Return the bytes of stack that a call needs, about."""
    size = 4 if interface.precision.is_single else 8
    k, m = len(interface.constraints), len(interface.inputs)
    values = 2 * k * (m + 2)
    arrays = size * (interface.scratch + values + 4 * (len(interface.states) + m) + 8 * k)
    # Calls within each other, and what compilers add.
    return 512 * math.ceil((2 * arrays + 512) / 512)


def struct_text(name: str, doc: str, quantities: Sequence[Quantity], real: str) -> str:
    """Return the struct of some quantities; "" of none.

    Args:
        name: of the struct.
        doc: what it is.
        quantities: its fields.
        real: type of numbers.
    """
    if not quantities:
        return ""
    lines = "\n".join(f"    {real} {q.name}; /* {q.described} */" for q in quantities)
    return f"/* {doc} */\ntypedef struct {{\n{lines}\n}} {name};\n"


DOCUMENTED = {
    "decide": "Solve the QP of the filter at a state.",
    "barrier_values": "Return the barriers at a state.",
    "filter_values": (
        "Return the constraints at a state: the coefficients and the offset of each, and what"
        " follows."
    ),
}


class FilterProgram(NamedTuple):
    """What the C of a filter is written from.

    Attributes:
        source: the functions `decide` and `barrier_values`.
        data: their numbers.
        proposes: whether the filter pursues a goal of its own, in place of the proposed input.
        partial: numbers of the barriers that may have no value.
    """

    source: Source
    data: Data
    proposes: bool
    partial: tuple[int, ...]


def filter_program(safety_filter: SafetyFilter) -> FilterProgram:
    """Return the functions of a filter, which take the input bounds at run time.

    Args:
        safety_filter: the filter.

    Raises:
        NotCompilableError: Learned terms have no compiled form.
    """
    qp, data = safety_filter.qp, Data()
    model = qp.model
    barriers = [model.numeric(barrier.expression) for barrier, _ in safety_filter.pairs]
    source = _Decision(qp, data).source()
    source += formulas("barrier_values", {"x": qp.symbols}, barriers, data)
    return FilterProgram(source, data, qp.clf is not None, qp.partial_barriers)


class _Decision(ArrayDecision):
    """Writes `decide` with the input bounds as arguments, and all that a decision tells."""

    parameters = "x, u, lowest, highest, data, work"

    def __init__(self, qp: FilterQP, data: Data) -> None:
        super().__init__(qp, data)
        self._body = _WritableBody(data)
        # They depend on the input bounds.
        self._planes = {}

    def _input_bounds(self) -> None:
        low, high = self._ends()
        self._body.vector("low", [*low, "0.0"][: self._m + self._goal])
        if not self._goal:
            self._body.vector("high", high)

    def _ends(self) -> tuple[list[str], list[str]]:
        low, high = ([f"{name}[{j}]" for j in range(self._m)] for name in ("lowest", "highest"))
        return low, high

    def _answer(self) -> None:
        body, k, m = self._body, self._k, self._m
        action = [f"action[{j}]" for j in range(m)]
        margin = [f"margin[{i}]" for i in range(k)]
        if self._single:
            body.add("cause = 0")
        else:
            body.call(
                furthest_constraint,
                f"{m}, a, {self._asked}, proposed, w, inside, active",
                "cause = ",
            )
        parts = {
            "chosen": action,
            "pursued": [f"proposed[{j}]" for j in range(m)],
            "reached": margin,
            "acting": [f"active[{i}]" for i in range(k)],
            "slack": [f"0.0 if feasible else max(-{g}, 0.0)" for g in margin],
        }
        body.add(*(f"{name} = ({''.join(f'{e}, ' for e in es)})" for name, es in parts.items()))
        body.add(f"return {', '.join(parts)}, feasible, cause, sound")


class _WritableBody(Body):
    """Puts constants into the scratch array: functions of C have one kind of array."""

    def constants(self, name: str, numbers: Sequence[float]) -> None:
        self.vector(name, [self.number(value) for value in numbers])


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


PREAMBLE = """\
 * Compile it as C99 with -ffp-contract=off and without -ffast-math: flags depend on the rounding
 * of sums and products.
 */
#include "filter.h"

#include <math.h>
#include <stddef.h>

#ifdef __FAST_MATH__
#error "compile the filter without -ffast-math: it tells numbers from NaN and rounding from misses"
#endif
#if defined(__FLT_EVAL_METHOD__) && __FLT_EVAL_METHOD__ == 2
#error "the filter needs sums in their own precision: compile with -msse2 -mfpmath=sse"
#endif
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF
#endif
"""
"""How every exported source goes on, from its first comment to its includes."""


def source_text(interface: Interface, program: FilterProgram) -> str:
    """Return filter.c.

    Args:
        interface: of the filter.
        program: what it is written from.

    Raises:
        NotCompilableError: Something in the filter has no form in C.
    """
    symbols = [q.name for q in (*interface.states, *interface.runtime)]
    terms = {"x": symbols, "u": [q.name for q in interface.inputs]}
    translated = CProgram(program.source, program.data, interface.precision, terms, DOCUMENTED)
    decide = translated.function("decide", [*[NUMBERS] * 5, VECTOR])
    barrier = translated.function("barrier_values", [NUMBERS, NUMBERS])
    needs_data = decide.used[4]
    given = ("x", "u", "low", "high", "data", "work")
    arguments = ", ".join(a for a, used in zip(given, decide.used, strict=True) if used)
    call = f"decide({arguments})"
    of_barrier = f"barrier_values({'x' if barrier.used[0] else ''})"
    public = public_functions(interface, program, call, of_barrier, needs_data)
    return wrapped(
        f"""/* {MARK}: a safety filter.
 *
 * {interface.about}
 *
{PREAMBLE}
{translated.text()}
{translated.data_table() if needs_data else ""}{public}"""
    )


def cmake_text(interface: Interface) -> str:
    """Return CMakeLists.txt: a static library, and the self-test as a test."""
    name = interface.name
    return f"""# {MARK}.
cmake_minimum_required(VERSION 3.10)
project({name} C)

set(CMAKE_C_STANDARD 99)
set(CMAKE_C_STANDARD_REQUIRED ON)
set(CMAKE_C_EXTENSIONS OFF)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()

add_library({name} STATIC filter.c)
target_include_directories({name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
add_executable({name}_selftest selftest.c)
target_link_libraries({name}_selftest PRIVATE {name})
foreach(target {name} {name}_selftest)
  if(MSVC)
    target_compile_options(${{target}} PRIVATE /fp:precise)
  else()
    target_compile_options(${{target}} PRIVATE -ffp-contract=off)
    target_link_libraries(${{target}} PRIVATE m)
  endif()
endforeach()

enable_testing()
add_test(NAME {name}_selftest COMMAND {name}_selftest)
"""


def readme_text(interface: Interface) -> str:
    """Return README.md."""
    name, macro = interface.name, interface.macro
    statuses = "\n".join(f"| {i} | `{macro}_{w}` | {m} |" for i, (w, m) in enumerate(STATUSES))
    constraints = "\n".join(
        f"| {i} | `{macro}_CONSTRAINT_{own}` | {_cell(barrier)} |"
        for i, (own, barrier) in enumerate(
            zip(interface.constraints, interface.barriers, strict=True)
        )
    )
    ends = "\n".join(
        f"| `{q.name}` | {_cell(q.symbol)} | {_cell(q.unit)} | {low!r} | {high!r} |"
        for q, low, high in zip(interface.inputs, interface.low, interface.high, strict=True)
    )
    runtime = (
        "## Quantities measured at run time: `input.runtime`\n\n"
        f"{quantities_table(interface.runtime)}\n\n"
        if interface.runtime
        else ""
    )
    goal = (
        "The filter pursues a goal of its own: the proposed input has no effect, and `pursued` is"
        " the\ninput that the goal alone would ask for.\n\n"
        if interface.proposes
        else ""
    )
    return f"""<!-- {MARK}. -->
# A safety filter in C

{filter_text(interface)}

`filter.c` and `filter.h` are C99 in {interface.precision.type} precision and need nothing but
`<math.h>`. Nothing is allocated, all loops are bounded, and nothing is kept between calls.

## Use

```c
#include "filter.h"

{name}_input input;
{name}_result result;
{name}_defaults(&input);            /* input bounds for which the filter was made */
input.state.{interface.states[0].name} = ...;       /* all states and the proposed input */
if ({name}_decide(&input, &result) != {macro}_OK) {{
    /* result.action is the middle of the input bounds: choose what is safe on your machine */
}}
/* send result.action */
```

{goal}## States: `input.state`

{quantities_table(interface.states)}

{runtime}## Inputs: `input.proposed`, `input.low`, `input.high`, `result.action`

The bounds are those of the actuators at this moment; the table has the defaults.

| Name | Symbol | Unit | Low | High |
|---|---|---|---|---|
{ends}

## Constraints: `barrier`, `margin`, `slack` and `active` in `result`

| Index | Name | Barrier |
|---|---|---|
{constraints}

## Status

| Code | Name | Meaning |
|---|---|---|
{statuses}

`feasible` is false where no input within its bounds meets all constraints. The action is then the
nearest of those that violate them least, and `slack` says by how much.

## Build

```console
cmake -B build && cmake --build build && ctest --test-dir build
```

or `cc -std=c99 -O2 -ffp-contract=off filter.c selftest.c -lm && ./a.out`.

Never use `-ffast-math`: then NaN goes unnoticed and rounding decides flags; `filter.c` refuses to
be compiled with it. Keep `-ffp-contract=off`: fused products round otherwise than Python does. Do
not let the processor flush small numbers to zero. The golden cases of `selftest.c` are decisions of
the filter in Python.
"""


def filter_text(interface: Interface) -> str:
    """Return what the filter is, and a table of its barriers."""
    lines = "\n".join(
        f"| {_cell(name)} | {_code(h)} |"
        for name, h in zip(interface.barriers, interface.formulas, strict=True)
    )
    return (
        f"Filter: {_code(interface.title)}\n\n"
        f"| Barrier | h, safe where not negative |\n|---|---|\n{lines}"
    )


def _code(text: str) -> str:
    return "`" + " ".join(text.split()).replace("|", "\\|").replace("`", "'") + "`"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def quantities_table(quantities: Sequence[Quantity]) -> str:
    """Return a table of names, symbols and units."""
    lines = "\n".join(f"| `{q.name}` | {_cell(q.symbol)} | {_cell(q.unit)} |" for q in quantities)
    return f"| Name | Symbol | Unit |\n|---|---|---|\n{lines}"
