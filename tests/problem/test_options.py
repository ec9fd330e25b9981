"""The options of a problem: read from texts, checked, and the same for every interface."""

from __future__ import annotations

from dataclasses import fields
from typing import get_type_hints

import pytest

from safe_envs import ConfigurationError
from safe_envs.agents.sweeps.spec import ENV_OPTIONS, sections
from safe_envs.problem.options import (
    OPTION_NAMES,
    PARAMETER_GROUPS,
    WHOLE_OPTIONS,
    ProblemOptions,
)
from safe_envs.registry import make_problem

READERS = {option.name: option.metadata["reader"] for option in fields(ProblemOptions)}


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("noise", "0.2", 0.2),
        ("noise", "0.1,.2,0", [0.1, 0.2, 0.0]),
        ("start", "-1,2e1,.5", [-1.0, 20.0, 0.5]),
        ("start", "inward", "inward"),
        ("input_bounds", ["-1,2"], [-1.0, 2.0]),
        ("input_bounds", ["-1,2", "0,3"], [[-1.0, 2.0], [0.0, 3.0]]),
        ("plant", ["v=.8", "m=-2"], {"v": 0.8, "m": -2}),
        ("barrier", ["kind=round", "power=3", "D=3.0"], {"kind": "round", "power": 3, "D": 3.0}),
    ],
)
def test_texts_become_values(name, text, value):
    assert repr(READERS[name](name, text)) == repr(value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("noise", "a", "--noise 'a'"),
        ("noise", "", "--noise ''"),
        ("start", "1,b", "--start '1,b'"),
        ("input_bounds", ["1"], "'1' has 1 numbers"),
        ("input_bounds", ["1,2,3"], "'1,2,3' has 3 numbers"),
        ("input_bounds", ["a,b"], "'a,b'"),
        *(("plant", [text], "NAME=VALUE") for text in ("v", "=1", "v=")),
        ("plant", ["v=1", "v=2"], "comes twice"),
        ("model", ["v=fast"], "'fast' is not a number"),
    ],
)
def test_texts_of_another_form_are_named(name, text, message):
    with pytest.raises(ConfigurationError, match=message):
        READERS[name](f"--{name}", text)


def test_every_option_can_be_varied_by_a_sweep():
    kinds = get_type_hints(ProblemOptions)
    assert {name for name, kind in kinds.items() if kind == int | None} == set(WHOLE_OPTIONS)
    grid = {"delay": [0, 2], "model_delay": [0, 1], "substeps": [1], "slew_limit": [[-1, 1]]}
    fixed = {"env": "Pendulum-v0", "filter": "scbf"}
    _, found, _ = sections({"fixed": fixed, "grid": grid}, "a sweep")
    assert repr(found) == repr(grid | {"slew_limit": [[-1.0, 1.0]]})
    forms = ["default", ["default", "delay=2"], {"theta": 0.1, "delay": 1}]
    listed = sections({"fixed": fixed, "grid": {"measurement": forms}}, "a sweep")[1]["measurement"]
    assert listed == [["default"], ["default", "delay=2"], ["theta:noise=0.1", "delay=1"]]
    with pytest.raises(ConfigurationError, match="a sweep: fixed: measurement = 3; give 'default'"):
        sections({"fixed": fixed | {"measurement": 3}}, "a sweep")
    with pytest.raises(ConfigurationError, match=r"delay = -1; give a whole number from 0"):
        sections({"fixed": fixed | {"delay": -1}}, "a sweep")
    assert {*ENV_OPTIONS, *PARAMETER_GROUPS} == {"system", *OPTION_NAMES}


def test_arguments_of_the_barrier_go_to_its_function():
    problem = make_problem("Scalar-v0", noise=0.0, limit=2.0)
    assert problem == make_problem("Scalar-v0", barrier={"limit": 2.0}).configured(noise=0.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dt": "fast"}, "dt = "),
        ({"horizon": float("nan")}, "horizon = "),
        ({"plant": 3}, "plant = "),
        ({"barrier": {"limit": 1.0}}, "no barrier argument"),
        ({"nois": 0.0}, "did you mean 'noise'"),
    ],
)
def test_options_that_mean_nothing_are_refused(options, message):
    with pytest.raises(ConfigurationError, match=message):
        make_problem("Scalar-v0").configured(**options)
