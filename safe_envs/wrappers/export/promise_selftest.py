"""The self-test of an exported promise filter: cases that Python has decided."""

from __future__ import annotations

from collections.abc import Iterable

from safe_envs.wrappers.export.c_header import MARK
from safe_envs.wrappers.export.c_program import wrapped
from safe_envs.wrappers.export.interface import Interface
from safe_envs.wrappers.export.promise_reference import PromiseCases, PromiseDecisions


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
