"""The source of an exported filter."""

from __future__ import annotations

from safe_envs.wrappers.export.c_header import MARK
from safe_envs.wrappers.export.c_program import CProgram, wrapped
from safe_envs.wrappers.export.c_public import public_functions
from safe_envs.wrappers.export.decision import DOCUMENTED, FilterProgram
from safe_envs.wrappers.export.interface import Interface
from safe_envs.wrappers.export.kinds import NUMBERS, VECTOR

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
