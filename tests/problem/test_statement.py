"""Problems of one's own: what is left out gets what suits, and mistakes are found before the first
step."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import get_type_hints

import numpy as np
import pytest
import sympy as sp

from safe_envs import (
    Barrier,
    ConfigurationError,
    ControlAffineSDE,
    RelativeDegreeError,
    SafeEnv,
    SafeVectorEnv,
    SystemDefinitionError,
    SystemDefinitionWarning,
    define_problem,
)
from safe_envs.agents.sweeps.spec import ENV_OPTIONS, sections
from safe_envs.problem.clf import CLF
from safe_envs.problem.options import OPTION_NAMES, PARAMETER_GROUPS, WHOLE_OPTIONS, ProblemOptions
from safe_envs.problem.signals import TIME, Feature
from safe_envs.problem.validation import require_sound
from safe_envs.registry import make_problem
from safe_envs.wrappers import SafetyFilter

x, v, u, w, k, sigma = sp.symbols("x v u w k sigma", real=True)
SYSTEM = ControlAffineSDE.from_rate(
    (x, v), (u,), [v, k * u - x], diffusion=[0, sigma], parameters={k: 2.0, sigma: 0.1}
)
NUMBERS = {"input_bounds": (-5.0, 5.0), "start": [(-0.5, 0.5), 0.0], "dt": 0.05, "horizon": 2.0}


def stated(system: ControlAffineSDE = SYSTEM, barriers: object = 1 - x**2, **numbers):
    return define_problem(system, barriers, **{**NUMBERS, **numbers})


def features(*names):
    return tuple(Feature(n, state, -5.0, 5.0) for n, state in zip(names, (x, v), strict=True))


IDLE = ControlAffineSDE((x, v), (u, w), [v, 0], [[0, 0], [1, 0]], [0, 0])
BY_NO_INPUT = ControlAffineSDE((x, v), (u,), [-x, 0], [0, 1], [0, 0])
BY_K = ControlAffineSDE((x, v), (u,), [v, 0], [0, 1 / k], [0, 0], {k: 1.0})
TWO_GAINS = ((1.0, 1.0), (1.0, 1.0))


def test_what_is_left_out_gets_what_suits():
    problem = stated()
    assert problem.model == problem.plant == SYSTEM
    assert problem.noise == ("sigma",)
    assert problem.gains == (1.0, 1.0)
    assert problem.filter == "szcbf"
    assert problem.plane == ("x", "v")
    assert [(s.low, s.high) for s in problem.states] == [(-math.inf, math.inf)] * 2
    assert stated(SYSTEM.with_parameters(sigma=0.0)).filter == "hocbf"


def test_barriers_of_different_degrees_get_gains_each():
    problem = stated(barriers=[1 - x**2, Barrier(4 - v**2, "speed")])
    assert problem.gains == ((1.0, 1.0), (1.0,))
    assert [b.name for b in problem.barriers] == ["h_1", "speed"]


def test_starts_are_drawn_from_the_ranges_where_all_barriers_are_positive():
    envs = SafeVectorEnv(stated(start=[(-2.0, 2.0), (0.0, 3.0)], barriers=[1 - x**2, 2 - v]), 200)
    envs.reset(seed=0)
    position, speed = envs.components
    assert (abs(position) < 1).all()
    assert (speed < 2).all()
    assert position.std() > 0.4


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"barriers": x**2 - 1}, SystemDefinitionError, "wrong sign"),
        ({"start": [2.0, 0.0]}, SystemDefinitionError, "every start is unsafe"),
        ({"barriers": [1 - x**2, x - 3]}, SystemDefinitionError, "every start is unsafe: h_2"),
        ({"barriers": [x - 0.1, -0.2 - x]}, SystemDefinitionError, "all barriers at once"),
        ({"barriers": sp.Integer(1)}, RelativeDegreeError, "no relative degree"),
        ({"barriers": sp.Min(1 - x, 1 - v)}, RelativeDegreeError, "different relative degrees"),
        ({"barriers": 1 - w**2}, SystemDefinitionError, "symbol w"),
        ({"barriers": 1 - sp.sqrt(x - 5)}, SystemDefinitionError, "no finite value at the start"),
        ({"barriers": []}, SystemDefinitionError, "barriers is empty"),
        ({"barriers": 1 - x**2 > 0}, SystemDefinitionError, "the expression itself"),
        ({"barriers": "1 - x**2"}, SystemDefinitionError, "give a sympy expression"),
        ({"nominal": lambda state: -state}, SystemDefinitionError, "nominal is a function"),
        ({"nominal": sp.log(x - 5)}, SystemDefinitionError, "nominal controller has no finite"),
        ({"nominal": [u, u]}, SystemDefinitionError, "nominal expression for each of the 1"),
        ({"gains": (1.0,)}, SystemDefinitionError, "relative degree is 2"),
        ({"gains": (1.0, -1.0)}, SystemDefinitionError, "positive numbers"),
        ({"barriers": [1 - x**2, 2 - v], "gains": TWO_GAINS}, SystemDefinitionError, "of h_2"),
        ({"noise": 0.1}, ConfigurationError, "parameters of the diffusion"),
        ({"plane": ("x", "y")}, ConfigurationError, "names states"),
        ({"filters": "scbf"}, ConfigurationError, "did you mean 'filter'"),
        ({"workspace": {x: (2.0, 3.0)}}, SystemDefinitionError, "outside the workspace"),
        ({"workspace": {"x": (-2.0, 3.0)}}, SystemDefinitionError, "the symbol itself"),
        ({"start": [(0.0, math.inf), 0.0]}, ConfigurationError, "not finite"),
        ({"input_bounds": (1.0, -1.0)}, ConfigurationError, "lower one below the upper"),
        ({"input_bounds": [(-1.0, 1.0), (-1.0, 1.0)]}, ConfigurationError, "give \\(low, high\\)"),
        ({"system": IDLE}, SystemDefinitionError, "input w never appears"),
        ({"system": BY_NO_INPUT}, RelativeDegreeError, "no action can keep it positive"),
        ({"model": SYSTEM.with_parameters(k=0)}, SystemDefinitionError, "input u never appears"),
        ({"system": BY_K, "model": BY_K.with_parameters(k=0)}, ConfigurationError, "by 0"),
        ({"features": features("x", "x")}, SystemDefinitionError, "named twice.*: x"),
        ({"features": features("x", "k")}, SystemDefinitionError, "like a parameter: k"),
    ],
)
def test_mistakes_are_found_and_explained(change, error, says):
    with pytest.raises(error, match=says):
        stated(**change)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"input_bounds": (-500.0, 500.0), "workspace": {v: (-3.0, 3.0)}},
            "across its whole workspace",
        ),
        ({"nominal": -5000 * (x + 2)}, "check that both have the unit"),
        (
            {"input_bounds": (-1e-4, 1e-4), "start": [0.9, 0.9]},
            "the input bounds are too narrow for h",
        ),
        ({"start": [(-300.0, 300.0), 0.0]}, "degrees for radians"),
    ],
)
def test_what_other_units_would_explain_is_doubtful(change, says):
    with pytest.warns(SystemDefinitionWarning, match=says) as told:
        problem = stated(**change)
    assert len(told) == 1
    require_sound(problem)  # Once for each problem.
    assert len(told) == 1


def test_what_is_sound_is_not_doubted():
    stated(
        system=ControlAffineSDE.from_rate((x, v), (u,), [v, u - 1000]),
        input_bounds=(990.0, 1010.0),
        workspace={v: (-50.0, 50.0)},
    )
    by_the_noise_alone = ControlAffineSDE((x, v), (u,), [-x, 0], [0, 1], [v, 0])
    assert len(stated(by_the_noise_alone).gains) == 2


def test_starts_are_in_the_workspace_and_where_the_system_has_a_value():
    system = ControlAffineSDE.from_rate((x,), (u,), [sp.sqrt(x) + u])
    problem = define_problem(
        system,
        x - 0.1,
        input_bounds=(-5, 5),
        start=[(-0.5, 2.0)],
        dt=0.1,
        horizon=1.0,
        workspace={x: (0.5, 3.0)},
    )
    envs = SafeVectorEnv(problem, 100)
    envs.reset(seed=0)
    assert envs.components[0].min() >= 0.5
    assert envs.components[0].max() < 2.0


def test_arrays_are_taken_for_start_and_box():
    assert stated(start=np.array([0.1, 0.0]), input_bounds=np.array([-5.0, 5.0])).input_bounds == (
        (-5.0, 5.0),
    )
    assert stated(
        start=np.array([[-0.1, 0.1], [0.0, 0.0]]), input_bounds=np.array([[-5.0, 5.0]])
    ).input_bounds == ((-5.0, 5.0),)


def test_what_is_given_is_what_the_problem_has():
    model = SYSTEM.with_parameters(k=1.5)
    noise_in_drift = ControlAffineSDE(
        (x, v), (u,), [v, sigma], [0, 1], [0, k * sigma], {k: 2.0, sigma: 0.1}
    )
    problem = stated(
        model=model, units={x: "m", u: "N"}, reward=3 - v, filter="scbf", gains=(3.0, 4.0)
    )
    assert problem.model == model
    assert [s.unit for s in (*problem.states, *problem.inputs)] == ["m", "", "N"]
    assert (problem.reward, problem.filter, problem.gains) == (3 - v, "scbf", (3.0, 4.0))
    assert stated(noise_in_drift).noise == ("k",)


def test_boxes_without_zero_and_several_inputs_are_weighed_rightly():
    # Only u near 9 or above keeps the state: |u| alone would say that the box holds twice what is
    # needed.
    drift = ControlAffineSDE.from_rate((x,), (u, w), [u + w - 4000])
    with pytest.warns(SystemDefinitionWarning, match="the inputs make up 10"):
        define_problem(
            drift,
            x + 1,
            input_bounds=[(-30.0, 4.0), (-30.0, 6.0)],
            start=[0.0],
            dt=0.01,
            horizon=1.0,
            nominal=[0, 0],
        )


def test_a_root_of_a_square_is_the_size_of_a_real_state():
    assert stated(barriers=1 - sp.sqrt(x**2)).barriers[0].expression == 1 - sp.Abs(x)


@pytest.mark.parametrize("name", ["t", "sin", "x_{1}", "_c0"])
def test_names_of_symbols_are_free_and_scalar_and_vector_envs_agree(name):
    def episode(state, force, rate):
        system = ControlAffineSDE(
            (state, v), (force,), [sp.sin(v) * rate, 0], [0, 1], [0, sigma], {rate: 2.0, sigma: 0.3}
        )
        problem = define_problem(
            system,
            1 - state**2 - sp.sin(state) ** 2,
            **{**NUMBERS, "input_bounds": (-1, 1)},
            nominal=-state,
            reward=state * force * sp.cos(TIME),
        )
        scalar, batch = SafeEnv(problem), SafeVectorEnv(problem, 2)
        scalar.reset(seed=0)
        batch.reset(seed=0)
        one = [scalar.step([0.5]) for _ in range(3)][-1]
        many = [batch.step(np.full((2, 1), 0.5)) for _ in range(3)][-1]
        np.testing.assert_array_equal(one[0], many[0][0])
        assert one[1] == pytest.approx(many[1][0])
        filtered = SafetyFilter.for_problem(problem, "hocbf").filter([0.3, 0.9], [1.0])
        return [*one[0], one[1], many[1][1], *filtered.action, *filtered.barrier]

    plain, other = episode(x, u, k), sp.Symbol(name, real=True)
    for symbols in ((other, u, k), (x, other, k), (x, u, other)):
        assert episode(*symbols) == pytest.approx(plain, rel=1e-12)


@pytest.mark.parametrize("h", [1 - sp.Abs(x), sp.Min(1 - x, 1 + x), sp.Max(0.5 - x, 1 - x**2)])
def test_a_barrier_with_kinks_under_noise_is_kept_by_its_pieces_or_refused(h):
    system = ControlAffineSDE((x,), (u,), [0], [1], [sigma], {sigma: 0.3})
    problem = stated(system, h, input_bounds=(-1, 1), start=[0.1])
    env = SafeEnv(problem)
    env.reset(seed=0)
    env.step([1.0])
    assert SafetyFilter.for_problem(problem, "cbf").filter([0.9], [1.0]).feasible
    if isinstance(h, sp.Max):
        with pytest.raises(SystemDefinitionError, match="is a maximum, which scbf cannot keep"):
            SafetyFilter.for_problem(problem, "scbf")
        return
    found, listed = (
        SafetyFilter(system, each, "scbf", (-1, 1)).filter([0.9], [1.0])
        for each in (h, [1 - x, 1 + x])
    )
    assert found.action == listed.action


@pytest.mark.parametrize("given", [{"V": "x**2"}, {"V": x**2, "input_weight": "1 + 1"}])
def test_a_text_is_no_function(given):
    # Sympy reads texts by Python's eval.
    with pytest.raises(SystemDefinitionError, match="is a text"):
        CLF(**given)


# The options of a problem: read from texts, checked, and the same for every interface.


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
