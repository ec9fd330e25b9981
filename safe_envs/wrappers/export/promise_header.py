"""The header of an exported promise filter, and its README."""

from __future__ import annotations

import math

from safe_envs.wrappers.export.build_files import filter_text, quantities_table
from safe_envs.wrappers.export.c_header import MARK, struct_text
from safe_envs.wrappers.export.c_program import wrapped
from safe_envs.wrappers.export.interface import Interface

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
