"""The options of `evaluate` are those of its specs: each default is stated once."""

from __future__ import annotations

import inspect
from dataclasses import MISSING, fields
from typing import Any, get_args, get_type_hints

import pytest

from safe_envs.agents.evaluation.spec import EvaluationSpec, RunSettings
from safe_envs.agents.rare_events.estimate import estimate_rare
from safe_envs.scripts.evaluate import evaluate

OF_SPECS: dict[str, Any] = {
    field.name: field.default
    for schema in (EvaluationSpec, RunSettings)
    for field in fields(schema)
    if field.default is not MISSING
}
OF_RARE = {
    name: parameter.default
    for name, parameter in inspect.signature(estimate_rare).parameters.items()
    if name in ("particles", "repetitions")
}
OF_COMMAND = inspect.signature(evaluate).parameters


@pytest.mark.parametrize("name", [name for name in (*OF_SPECS, *OF_RARE) if name in OF_COMMAND])
def test_a_default_is_that_of_the_spec(name):
    default = {**OF_SPECS, **OF_RARE}[name]
    if OF_COMMAND[name].default is not None:
        assert OF_COMMAND[name].default == default
        return
    # One that is left to the spec; the help says which it is, where it has one.
    (_, option) = get_args(get_type_hints(evaluate, include_extras=True)[name])
    assert default in (None, ()) or option.show_default == str(default)


def test_all_that_a_spec_asks_is_an_option():
    # A command keeps no episodes: --episodes-out writes them. --filter NAME@state names each row.
    elsewhere = {"problem", "options", "bounds", "record", "progress", "keep_episodes"}
    elsewhere.add("compare_estimates")
    names = {field.name for schema in (EvaluationSpec, RunSettings) for field in fields(schema)}
    assert names - elsewhere <= {*OF_COMMAND}
