"""The self-test of an exported filter: cases that Python has decided."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from safe_envs.wrappers.export.c_header import MARK
from safe_envs.wrappers.export.c_program import wrapped
from safe_envs.wrappers.export.interface import Interface
from safe_envs.wrappers.export.reference import Cases, Decisions


def selftest_text(interface: Interface, cases: Cases, decisions: Decisions) -> str:
    """Return selftest.c.

    Args:
        interface: of the filter.
        cases: what it is asked.
        decisions: what it is to decide.
    """
    name, macro, real = interface.name, interface.macro, interface.precision.type
    tolerance = 2e-3 if interface.precision.is_single else 1e-9
    golden = "\n".join(_case(interface, cases, decisions, i) for i in range(len(decisions.status)))
    checks = "\n".join(
        f"""        failed += differs(i, "{q.name}", result.action.{q.name},
            cases[i].action.{q.name}, half_width(c->high.{q.name} - c->low.{q.name}));"""
        for q in interface.inputs
    )
    number = interface.precision.number
    return wrapped(
        f"""/* {MARK}: golden cases of the filter, decided by Python.
 *
 * The program prints what differs, and ends with 1 if anything does.
 */
#include "filter.h"

#include <math.h>
#include <stddef.h>
#include <stdio.h>

/* By how much an action may differ, in half widths of the input bounds. */
static const {real} tolerance = {number(tolerance)};

typedef struct {{
    {name}_input input;
    {name}_inputs action;
    bool active[{macro}_CONSTRAINTS];
    bool feasible;
    int cause;
    {name}_status status;
}} golden_case;

static const golden_case cases[] = {{
{golden}
}};

static {real} half_width({real} width)
{{
    return width > 0 ? {number(0.5)} * width : 1;
}}

/* Return whether a number differs from the golden one, and say so. */
static int differs(size_t place, const char *what, {real} found, {real} golden, {real} scale)
{{
    const {real} error = found > golden ? found - golden : golden - found;
    if (error <= tolerance * scale) {{
        return 0;
    }}
    printf("case %lu: %s is %.17g, not %.17g\\n", (unsigned long)place, what, (double)found,
        (double)golden);
    return 1;
}}

/* Return whether a flag differs from the golden one, and say so. */
static int flag_differs(size_t place, const char *what, int found, int golden)
{{
    if (found == golden) {{
        return 0;
    }}
    printf("case %lu: %s is %d, not %d\\n", (unsigned long)place, what, found, golden);
    return 1;
}}

int main(void)
{{
    const size_t count = sizeof(cases) / sizeof(cases[0]);
    int failed = 0;
    for (size_t i = 0; i < count; i++) {{
        const {name}_input *c = &cases[i].input;
        {name}_result result;
        const {name}_status status = {name}_decide(c, &result);
        failed += flag_differs(i, "status", (int)status, (int)cases[i].status);
        failed += flag_differs(i, "feasible", result.feasible, cases[i].feasible);
        failed += flag_differs(i, "cause", result.cause, cases[i].cause);
        for (int k = 0; k < {macro}_CONSTRAINTS; k++) {{
            failed += flag_differs(i, "active", result.active[k], cases[i].active[k]);
        }}
{checks}
    }}
    printf("%lu golden cases, %d differences\\n", (unsigned long)count, failed);
    return failed ? 1 : 0;
}}
"""
    )


def _case(interface: Interface, cases: Cases, decisions: Decisions, i: int) -> str:
    groups = [cases.states[i], *([cases.runtime[i]] if interface.runtime else [])]
    groups += [cases.proposed[i], cases.low[i], cases.high[i]]
    given = ", ".join(_braced(interface, group) for group in groups)
    active = ", ".join("true" if a else "false" for a in decisions.active[i])
    status = int(decisions.status[i])
    return (
        f"    {{{{{given}}}, {_braced(interface, decisions.action[i])}, {{{active}}},"
        f" {'true' if decisions.feasible[i] else 'false'}, {int(decisions.cause[i])},"
        f" ({interface.name}_status){status}}},"
    )


def _braced(interface: Interface, values: Iterable[float] | np.ndarray) -> str:
    number = interface.precision.number
    return "{" + ", ".join(number(float(v)) for v in values) + "}"
