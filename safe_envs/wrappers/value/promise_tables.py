"""The tables of promise filters: each is in memory once, however many filters look it up."""

from __future__ import annotations

import json
import weakref
from collections.abc import Callable
from dataclasses import replace

from safe_envs.errors import ConfigurationError
from safe_envs.problem.named_sets import set_names
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.automaton_building import automaton_of
from safe_envs.wrappers.value.look_ahead import LookAhead
from safe_envs.wrappers.value.product_states import keeps_safe
from safe_envs.wrappers.value.promise_filter import PromiseFilter
from safe_envs.wrappers.value.promise_text import PromiseSettings
from safe_envs.wrappers.value.reduction import reduced
from safe_envs.wrappers.value.settings import ValueSettings
from safe_envs.wrappers.value.specification import Specification
from safe_envs.wrappers.value.table_cache import table_for

_IN_USE: weakref.WeakValueDictionary[str, LookAhead] = weakref.WeakValueDictionary()
"""Tables that some filter looks up, of this process."""


def promise_filter_for(
    problem: SafetyProblem,
    settings: PromiseSettings,
    knowledge: str = "model",
    progress: Callable[[float], None] | None = None,
) -> PromiseFilter:
    """Return the promise filter of a problem, whose table may have to be computed first.

    Args:
        problem: that is to be kept safe.
        settings: what is asked for.
        knowledge: whose step is in the table, that of the "model" or of the "plant".
        progress: called with the part of the table that is computed, from 0 to 1.

    Raises:
        ConfigurationError: The settings do not fit the problem, it has too many coordinates or
            unbounded ones, or the file of a table is of another problem.
    """
    settings.require_fit(problem)
    wanted = ValueSettings(
        knowledge=knowledge,
        leaving=settings.leaving,
        intervals=settings.intervals,
        specification=settings.specification,
    )
    fingerprint = reduced(
        problem, knowledge, settings.intervals, settings.specification
    ).fingerprint
    if problem.model == problem.plant:
        # Then a table of the plant is one of the model, and may be there already.
        wanted = replace(wanted, knowledge="plant")
    key = json.dumps([fingerprint, wanted.as_dict(), settings.table])
    look_ahead = _IN_USE.get(key)
    if look_ahead is None:
        table = table_for(problem, wanted, progress, settings.table)
        look_ahead = _IN_USE[key] = LookAhead(table, problem)
    if progress is not None:
        progress(1.0)
    return PromiseFilter(look_ahead, settings, problem)


def why_not_of_plant(problem: SafetyProblem, settings: PromiseSettings, knowledge: str) -> str:
    """Return why the guarantee of a promise filter is not one for the plant; "" where it is.

    Args:
        problem: that is to be kept safe.
        settings: of the filter.
        knowledge: of the filter, "model" or "plant".
    """
    true = problem.plant.parameter_values
    outside = [
        f"{name} = {true[name]:g}"
        for name, low, high in settings.robust
        if name in true and not low <= true[name] <= high
    ]
    if outside:
        return f"the plant has {', '.join(outside)}, outside the intervals of the filter"
    if knowledge == "plant":
        return ""
    covered = {name: true[name] for name in settings.intervals if name in true}
    believed = replace(problem, model=problem.model.with_parameters(**covered))
    try:
        model, plant = (
            reduced(believed, whose, {}, settings.specification) for whose in ("model", "plant")
        )
        same = model.fingerprint == plant.fingerprint
    except ConfigurationError:
        same = False
    return "" if same else "the filter's guarantee is of the model, from which the plant differs"


def why_not_of_safety(problem: SafetyProblem, settings: PromiseSettings) -> str:
    """Return why the guarantee of a promise filter is not one of being safe; "" where it is.

    Args:
        problem: that is to be kept safe.
        settings: of the filter.
    """
    if not settings.specification:
        return ""
    specification = Specification(settings.specification, set_names(problem))
    if keeps_safe(automaton_of(specification)):
        return ""
    return f"it is of meeting {settings.specification!r}, which unsafe episodes may meet too"
