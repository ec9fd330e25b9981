"""The export of a promise filter: the texts of its files, and cases for its self-test."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.dynamics.integrators import Integrator
from safe_envs.errors import ConfigurationError
from safe_envs.export.c_expressions import (
    DOUBLE,
    FLOATS,
    NUMBERS,
    REAL,
    TRUTH,
    VECTOR,
    WHOLE,
    comment,
)
from safe_envs.export.c_files import (
    MARK,
    PREAMBLE,
    Interface,
    cmake_text,
    filter_text,
    formula_text,
    quantities_of,
    quantities_table,
    require_name,
    struct_text,
)
from safe_envs.export.c_statements import CProgram, wrapped
from safe_envs.export.export import ExportOptions, require_own, write_files
from safe_envs.values.look_ahead import LookAhead, draw_starts
from safe_envs.values.promise_filter import PromiseFilter, PromiseMemory
from safe_envs.values.promise_kernel import IN_CHOSEN
from safe_envs.values.promise_source import PromiseProgram, PromiseTables, promise_program

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


STATUSES = (
    ("OK", "the action is that of the filter"),
    ("INVALID_MEMORY", "the memory was never begun, or has been changed to what none has"),
    ("INVALID_INPUT", "a state or the proposed input is not finite"),
    ("UNDEFINED", "something has no finite value at this state"),
)
"""Status codes, in their order, and what they mean."""

_MEMORY = """typedef struct {{
    int instant; /* control periods that have passed */
    double promise; /* p_k of the last decision: what was still kept */
    double expected; /* q_k of the action that it chose */
    double cap; /* what the promise need not exceed at the next state; infinite for none */
    bool begun; /* whether there was a decision */
    unsigned key; /* tells a memory that was begun from any other */
}} {name}_memory;"""

_BEGIN = """Begin an episode: the next decision promises the wanted probability, or as much as its
 * state allows. Begin again whenever the state is not the one that the last action led to: after a
 * reset, a missed control period, a new estimate of the state, or an action that was not executed;
 * and after {steps} control periods, beyond which nothing is promised. What was promised
 * before is over then: each begin is a promise of its own."""


def promise_header(interface: Interface, steps: int, stack: int) -> str:
    """Return filter.h.

    Args:
        interface: of the filter.
        steps: control periods of the promise.
        stack: bytes that a call needs.
    """
    name, macro = interface.name, interface.macro
    statuses = "\n".join(
        f"    {macro}_{word} = {i}, /* {meaning} */" for i, (word, meaning) in enumerate(STATUSES)
    )
    begin = _BEGIN.format(steps=steps)
    return wrapped(
        f"""/* {MARK}: the interface of a promise filter.
 *
 * {interface.about}
 */
#ifndef {macro}_FILTER_H
#define {macro}_FILTER_H

#include <stdbool.h>

#ifdef __cplusplus
extern "C" {{
#endif

/* Numbers of states and of inputs, and the control periods of a promise. */
#define {macro}_STATES {len(interface.states)}
#define {macro}_INPUTS {len(interface.inputs)}
#define {macro}_STEPS {steps}

/* What became of a call. */
typedef enum {{
{statuses}
}} {name}_status;

{struct_text(f"{name}_state", "A state.", interface.states, "double")}
{struct_text(f"{name}_inputs", "An input.", interface.inputs, "double")}
/* What the filter is given. */
typedef struct {{
    {name}_state state;
    {name}_inputs proposed; /* input, to be filtered; brought into its bounds first */
}} {name}_input;

/* What the filter remembers from one control period to the next; of each plant its own. */
{_MEMORY.format(name=name)}

/* What the filter decides. Where the status is not {macro}_OK, the action is the middle of the
 * input bounds, nothing is promised until the memory is begun again, and feasible is false.
 */
typedef struct {{
    {name}_inputs action; /* input to be executed, always inside its bounds */
    double promise; /* p_k: probability of staying safe that is kept from here on */
    double expected; /* q_k: what the action keeps at least, not less than the promise */
    bool replaced; /* whether it is not the proposed input that is executed */
    bool feasible; /* whether anything is promised; else the action is the best one known */
    {name}_status status;
}} {name}_result;

/* {begin}
 */
void {name}_begin({name}_memory *memory);

/* Choose the input nearest to the proposed one that keeps the promise, and remember it. Call it
 * once in each control period, with the state that the last action led to, and execute the action.
 * Nothing is allocated, and nothing is kept but the memory: threads may call it with memories of
 * their own. It needs about {stack} bytes of stack.
 */
{name}_status {name}_decide({name}_memory *memory, const {name}_input *input,
    {name}_result *result);

#ifdef __cplusplus
}}
#endif

#endif
"""
    )


def promise_readme(interface: Interface, steps: int) -> str:
    """Return README.md.

    Args:
        interface: of the filter.
        steps: control periods of the promise.
    """
    name, macro = interface.name, interface.macro
    statuses = "\n".join(f"| {i} | `{macro}_{w}` | {m} |" for i, (w, m) in enumerate(STATUSES))
    ends = "\n".join(
        f"| `{q.name}` | {q.unit} | {low!r} | {high!r} |"
        for q, low, high in zip(interface.inputs, interface.low, interface.high, strict=True)
    )
    begin = " ".join(_BEGIN.format(steps=steps).replace("\n *", "").split())
    return f"""<!-- {MARK}. -->
# A promise filter in C

{filter_text(interface)}

`filter.c` and `filter.h` are C99 in double precision and need nothing but `<math.h>`. Nothing is
allocated, all loops are bounded, and what is kept between calls is in the memory of the caller.

## Use

```c
#include "filter.h"

{name}_memory memory;
{name}_input input;
{name}_result result;
{name}_begin(&memory);              /* at the start of each episode */
for (;;) {{                          /* once in each control period */
    input.state.{interface.states[0].name} = ...;   /* all states and the proposed input */
    if ({name}_decide(&memory, &input, &result) != {macro}_OK) {{
        /* result.action is the middle of the input bounds: choose what is safe on your machine */
    }}
    /* send result.action */
}}
```

{begin}

`promise` is the probability that is still kept of staying safe up to control period {steps}, if the
plant is the one of the table, the actions are executed, and the period of the loop is that of the
table. Where `feasible` is false nothing is kept, and the action is the best one that is known.

## States: `input.state`

{quantities_table(interface.states)}

## Inputs: `input.proposed`, `result.action`

The bounds are those of the table: others need another table.

| Name | Unit | Low | High |
|---|---|---|---|
{ends}

## Status

| Code | Name | Meaning |
|---|---|---|
{statuses}

## Build

```console
cmake -B build && cmake --build build && ctest --test-dir build
```

or `cc -std=c99 -O2 -ffp-contract=off filter.c selftest.c -lm && ./a.out`.

Never use `-ffast-math`: then NaN goes unnoticed and rounding decides; `filter.c` refuses to be
compiled with it. Keep `-ffp-contract=off`: fused products round otherwise than Python does. The
values are constant on cells, so that a state next to the edge of a cell may count to either side.
"""


def promise_stack(interface: Interface) -> int:
    """Return the bytes of stack that a call needs, about."""
    return 512 * math.ceil((8 * interface.scratch + 2048) / 512)


_PART = 4096
_BEYOND = 1.5
_DEFAULT = (-2.0, 2.0)


@dataclass(frozen=True)
class PromiseCases:
    """What a promise filter is asked.

    Attributes:
        states: states, shape (N, n).
        proposed: proposed inputs, shape (N, m).
        instants: control periods that have passed, int (N,); 0 for the start of an episode.
        levels: p_k of the decision before, shape (N,).
    """

    states: np.ndarray
    proposed: np.ndarray
    instants: np.ndarray
    levels: np.ndarray

    def at(self, rows: Any) -> PromiseCases:
        """Return some of the cases."""
        return PromiseCases(*(getattr(self, f.name)[rows] for f in fields(self)))

    def moved(self, step: np.ndarray) -> PromiseCases:
        """Return the cases with other states.

        Args:
            step: what is added, shape (N, n).
        """
        return PromiseCases(self.states + step, self.proposed, self.instants, self.levels)


@dataclass(frozen=True)
class PromiseDecisions:
    """Decisions at N states.

    Attributes:
        action: executed inputs, shape (N, m).
        level: p_k, shape (N,).
        expected: q_k of the action, shape (N,).
        replaced: whether it is not the proposed input, shape (N,).
    """

    action: np.ndarray
    level: np.ndarray
    expected: np.ndarray
    replaced: np.ndarray


def random_cases(
    promise_filter: PromiseFilter,
    region: Sequence[tuple[float, float]],
    count: int,
    rng: np.random.Generator,
) -> PromiseCases:
    """Draw cases uniformly; a proposed input may lie beyond its bounds.

    Known states are what they are to be, but for one case in fifty.

    Args:
        promise_filter: the filter.
        region: from which states are drawn; empty for (-2, 2) of each.
        count: how many.
        rng: source of random numbers.

    Returns:
        The cases.
    """
    problem, steps = promise_filter.problem, promise_filter.look_ahead.steps
    ends = np.array(list(region) or [_DEFAULT] * problem.plant.n, dtype=float)
    low, high = np.array(problem.input_bounds, dtype=float).T
    instants = rng.integers(0, steps + 2, count)
    instants[rng.random(count) < 0.1] = 0
    states = rng.uniform(ends[:, 0], ends[:, 1], (count, len(ends)))
    kept = rng.random(count) > 0.02
    for i, values in _assumed(promise_filter).items():
        states[kept, i] = values[np.minimum(instants[kept], steps)]
    half = 0.5 * (high - low)
    proposed = 0.5 * (low + high) + _BEYOND * half * rng.uniform(-1.0, 1.0, (count, len(low)))
    # Promises near 1, where they bind, and some that nothing is left of.
    promises = 1.0 - rng.random(count) ** 3
    promises[rng.random(count) < 0.05] = 0.0
    return PromiseCases(states, proposed, instants, promises)


def _assumed(promise_filter: PromiseFilter) -> Mapping[int, np.ndarray]:
    ahead = promise_filter.look_ahead
    return ahead.parts.reduced.assumed if isinstance(ahead, LookAhead) else {}


def decided(promise_filter: PromiseFilter, cases: PromiseCases) -> PromiseDecisions:
    """Return what the filter decides in Python, one step at a time.

    Args:
        promise_filter: the filter.
        cases: what it is asked.
    """
    count = len(cases.states)
    parts = [
        _decided(promise_filter, cases.at(slice(first, first + _PART)))
        for first in range(0, count, _PART)
    ]
    names = [f.name for f in fields(PromiseDecisions)]
    return PromiseDecisions(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def _decided(promise_filter: PromiseFilter, cases: PromiseCases) -> PromiseDecisions:
    count = len(cases.states)
    memory, x = PromiseMemory(promise_filter, count), tuple(cases.states.T.copy())
    starts = cases.instants == 0
    memory.restore(
        {
            "instant": np.maximum(cases.instants - 1, 0),
            "promise": cases.levels,
            "promise_ended": np.zeros(count, dtype=bool),
            "promise_automaton": np.zeros(count, dtype=int),
        }
    )
    memory.advance(x, False)
    if starts.any():
        memory.begin(x, starts)
    return decision_of(memory, x, clipped(promise_filter, cases.proposed))


def clipped(promise_filter: PromiseFilter, proposed: np.ndarray) -> np.ndarray:
    """Return proposed inputs inside their bounds, as a filter is given them.

    Args:
        promise_filter: the filter.
        proposed: shape (N, m).
    """
    low, high = np.array(promise_filter.problem.input_bounds, dtype=float).T
    return np.clip(proposed, low, high)


def decision_of(
    memory: PromiseMemory, x: tuple[np.ndarray, ...], proposed: np.ndarray
) -> PromiseDecisions:
    """Return what a memory decides at states.

    Args:
        memory: of episodes.
        x: components of the states.
        proposed: inputs within their bounds, shape (N, m).
    """
    found = memory.decide_arrays(x, tuple(proposed.T.copy()))
    margin = np.array(found.margin[0])
    promise = memory.levels
    return PromiseDecisions(
        np.array(found.action).T.reshape(len(x[0]), -1),
        promise.copy(),
        margin + promise,
        np.array(found.active[0]),
    )


class PromiseEpisodes:
    """Episodes of the plant under the filter in Python, with proposed inputs that are noise.

    Args:
        promise_filter: the filter.
        count: how many at once.
        seed: of starts, noise and inputs.

    Attributes:
        x: components of the states at hand.
    """

    def __init__(self, promise_filter: PromiseFilter, count: int, seed: int) -> None:
        problem = promise_filter.problem
        self._filter, self._rng = promise_filter, np.random.default_rng(seed)
        # There is one start alone where all are equal.
        starts = draw_starts(problem, count, seed)
        self.x = tuple(np.resize(np.asarray(c, dtype=float), count) for c in starts)
        self._memory = PromiseMemory(promise_filter, count)
        self._memory.begin(self.x)
        self._integrator = Integrator(problem.plant, problem.dt, problem.substeps, "arrays")

    def propose(self) -> np.ndarray:
        """Return proposed inputs, shape (N, m), that push to one side for a while."""
        low, high = np.array(self._filter.problem.input_bounds, dtype=float).T
        size = len(self.x[0])
        pushed = self._rng.random((size, len(low))) ** 0.2
        side = np.arange(size)[:, None] % 2
        return np.where(side, low + (high - low) * pushed, high - (high - low) * pushed)

    def decide(self, proposed: np.ndarray) -> PromiseDecisions:
        """Return what the filter decides at the states at hand.

        Args:
            proposed: inputs within their bounds, shape (N, m).
        """
        return decision_of(self._memory, self.x, proposed)

    def move(self, action: np.ndarray) -> None:
        """Go on under inputs, shape (N, m)."""
        draws = self._rng.standard_normal((self._integrator.channels, len(self.x[0])))
        with np.errstate(all="ignore"):
            moved = self._integrator.step(self.x, tuple(action.T), draws)
        self.x = tuple(np.broadcast_to(c, self.x[0].shape).astype(float) for c in moved)
        self._memory.advance(self.x, False)


def promise_selftest(interface: Interface, cases: PromiseCases, decisions: PromiseDecisions) -> str:
    """Return selftest.c.

    Args:
        interface: of the filter.
        cases: what it is asked.
        decisions: what it is to decide.
    """
    name, macro, number = interface.name, interface.macro, interface.precision.number

    def braced(values: Iterable[float]) -> str:
        return "{" + ", ".join(number(float(v)) for v in values) + "}"

    golden = "\n".join(
        f"    {{{{{braced(cases.states[i])}, {braced(cases.proposed[i])}}},"
        f" {int(cases.instants[i])}, {number(float(cases.levels[i]))},"
        f" {braced(decisions.action[i])}, {number(float(decisions.level[i]))},"
        f" {'true' if decisions.replaced[i] else 'false'}}},"
        for i in range(len(cases.states))
    )
    checks = "\n".join(
        f"""        failed += differs(i, "{q.name}", result.action.{q.name},
            cases[i].action.{q.name}, {number(1e-9 * (0.5 * (high - low) or 1.0))});"""
        for q, low, high in zip(interface.inputs, interface.low, interface.high, strict=True)
    )
    return wrapped(
        f"""/* {MARK}: golden cases of the filter, decided by Python.
 *
 * The program prints what differs, and ends with 1 if anything does.
 */
#include "filter.h"

#include <stddef.h>
#include <stdio.h>

typedef struct {{
    {name}_input input;
    int instant; /* 0 for the start of an episode */
    double before; /* the promise of the decision before */
    {name}_inputs action;
    double promise;
    bool replaced;
}} golden_case;

static const golden_case cases[] = {{
{golden}
}};

/* Return whether a number differs from the golden one, and say so. */
static int differs(size_t place, const char *what, double found, double golden, double allowed)
{{
    const double error = found > golden ? found - golden : golden - found;
    if (error <= allowed) {{
        return 0;
    }}
    printf("case %lu: %s is %.17g, not %.17g\\n", (unsigned long)place, what, found, golden);
    return 1;
}}

int main(void)
{{
    const size_t count = sizeof(cases) / sizeof(cases[0]);
    int failed = 0;
    for (size_t i = 0; i < count; i++) {{
        {name}_memory memory;
        {name}_result result;
        {name}_begin(&memory);
        if (cases[i].instant > 0) {{
            memory.instant = cases[i].instant;
            memory.promise = cases[i].before;
            memory.begun = true;
        }}
        const {name}_status status = {name}_decide(&memory, &cases[i].input, &result);
        failed += differs(i, "status", (double)status, (double){macro}_OK, 0);
        failed += differs(i, "replaced", result.replaced, cases[i].replaced, 0);
        failed += differs(i, "promise", result.promise, cases[i].promise, {number(1e-12)});
{checks}
    }}
    printf("%lu golden cases, %d differences\\n", (unsigned long)count, failed);
    return failed ? 1 : 0;
}}
"""
    )


LARGEST_TABLES = 2**24
"""Bytes of the tables of an export."""

_GOLDEN = 60


def export_promise(
    promise_filter: PromiseFilter,
    directory: Path | str,
    float32: bool = False,
    options: ExportOptions | None = None,
) -> Interface:
    """Write a promise filter as C99: filter.h, filter.c, selftest.c, CMakeLists.txt and README.md.

    Args:
        promise_filter: the filter.
        directory: where the files are to be; it is created where its parent exists.
        float32: whether the C is to compute in single precision, which a promise does not.
        options: names, units and the region of the golden cases.

    Returns:
        The interface of the exported filter.

    Raises:
        ConfigurationError: The tables are larger than 16 MB; or single precision is asked for; or
            the directory holds other files of these names; or an option is not allowed.
        NotCompilableError: Something in the filter has no form in C, such as a specification.
    """
    if float32:
        raise ConfigurationError(
            "bounds of a promise are rounded outwards in double precision; leave --float32 away"
        )
    folder, options = Path(directory), options or ExportOptions()
    require_own(folder)
    interface, texts = promise_sources(promise_filter, options)
    cases = golden_cases(promise_filter, options)
    texts |= {
        "selftest.c": promise_selftest(interface, cases, decided(promise_filter, cases)),
        "CMakeLists.txt": cmake_text(interface),
        "README.md": promise_readme(interface, promise_filter.look_ahead.steps),
    }
    write_files(folder, texts)
    return interface


def promise_sources(
    promise_filter: PromiseFilter, options: ExportOptions
) -> tuple[Interface, dict[str, str]]:
    """Return the interface of a promise filter, and the texts of its header and its source.

    Args:
        promise_filter: the filter.
        options: names and units.

    Raises:
        ConfigurationError: The name is no name of C, or the tables are larger than 16 MB.
        NotCompilableError: Something in the filter has no form in C.
    """
    require_name(options.name)
    program = promise_program(promise_filter, LARGEST_TABLES)
    problem, units = promise_filter.problem, options.units
    low, high = zip(*problem.input_bounds, strict=True)
    interface = Interface(
        options.name,
        comment(f"{replace(promise_filter.settings, table=None).text} for {problem.name}"),
        DOUBLE,
        quantities_of(problem.plant.states, units, {}),
        (),
        quantities_of(problem.plant.inputs, units, {}),
        (),
        tuple(b.name for b in problem.barriers),
        tuple(formula_text(problem.plant.numeric(b.expression)) for b in problem.barriers),
        tuple(map(float, low)),
        tuple(map(float, high)),
        False,
        False,
        program.source.work,
    )
    steps = promise_filter.look_ahead.steps
    return interface, {
        "filter.h": promise_header(interface, steps, promise_stack(interface)),
        "filter.c": promise_source_text(interface, program),
    }


def golden_cases(promise_filter: PromiseFilter, options: ExportOptions) -> PromiseCases:
    """Return a few cases whose decisions a small change of the state does not change.

    Args:
        promise_filter: the filter.
        options: with the region.
    """
    rng = np.random.default_rng(0)
    cases = random_cases(promise_filter, options.region, 8 * _GOLDEN, rng)
    found = decided(promise_filter, cases)
    step = 1e-9 * np.abs(cases.states) * rng.choice([-1.0, 1.0], cases.states.shape)
    other = decided(promise_filter, cases.moved(step))
    steady = (np.abs(found.action - other.action) <= 1e-7).all(axis=1)
    steady &= (np.abs(found.level - other.level) <= 1e-12) & (found.replaced == other.replaced)
    rows = np.flatnonzero(steady)
    # As many of each sort as there are.
    order = np.lexsort((rng.random(len(rows)), _rank(found.replaced[rows], found.level[rows])))
    return cases.at(rows[order[:_GOLDEN]])


def _rank(replaced: np.ndarray, promise: np.ndarray) -> np.ndarray:
    """Return the place of each case among those of its sort."""
    sort = replaced * 2 + (promise > 0.0)
    rank = np.zeros(len(sort), dtype=int)
    for each in np.unique(sort):
        rows = np.flatnonzero(sort == each)
        rank[rows] = np.arange(len(rows))
    return rank
