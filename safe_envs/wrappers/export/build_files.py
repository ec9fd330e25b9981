"""How an exported filter is built, and what its interface is: CMakeLists.txt and README.md."""

from __future__ import annotations

from collections.abc import Sequence

from safe_envs.wrappers.export.c_header import MARK, STATUSES
from safe_envs.wrappers.export.interface import Interface, Quantity


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
