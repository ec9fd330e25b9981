"""Notes on the bounds of promise filters."""

from __future__ import annotations

from collections.abc import Iterable

from safe_envs.wrappers.conditions.names import AT_STATE
from safe_envs.wrappers.conditions.text_parts import names_promise
from safe_envs.wrappers.value.promise_text import PromiseSettings


def computed_notes(names: Iterable[str]) -> list[str]:
    """Return what the bounds of promise filters are.

    Args:
        names: of the filters that have a bound.
    """
    found = [name for name in names if names_promise(name)]
    if not found:
        return []
    which = f"the bound of {found[0]} is" if len(found) == 1 else "bounds of promise filters are"
    notes = [
        f"held input, comp.: {which} computed, not proved: the mean of p_0 over the starts, which"
        " the filter keeps for every policy up to the horizon, in the floating-point numbers of its"
        " table."
    ]
    settings = {name: PromiseSettings.of_text(name.removesuffix(AT_STATE)) for name in found}
    tasks = [name for name, each in settings.items() if each.specification]
    if tasks:
        notes.append(
            f"what {' and '.join(tasks)} keeps is the probability of meeting the specification,"
            " at least the mean of min(p, L_0) of the starts: a bound of being safe too, since no"
            " unsafe episode meets it."
        )
    return notes
