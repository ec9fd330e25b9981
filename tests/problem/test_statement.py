"""Problems of one's own: what is left out gets what suits, and mistakes are found before the first
step."""

from __future__ import annotations

import math

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
    state_problem,
)
from safe_envs.problem.validation import require_sound

x, v, u, w, k, sigma = sp.symbols("x v u w k sigma", real=True)
SYSTEM = ControlAffineSDE.from_rate(
    (x, v), (u,), [v, k * u - x], diffusion=[0, sigma], parameters={k: 2.0, sigma: 0.1}
)
NUMBERS = {"box": (-5.0, 5.0), "start": [(-0.5, 0.5), 0.0], "dt": 0.05, "horizon": 2.0}


def stated(system: ControlAffineSDE = SYSTEM, barriers: object = 1 - x**2, **numbers):
    return state_problem(system, barriers, **{**NUMBERS, **numbers})


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


def test_scalar_and_vector_envs_agree():
    problem = stated(nominal=-v, reward=-(x**2), workspace={x: (-2.0, 2.0)})
    env, envs = SafeEnv(problem), SafeVectorEnv(problem, 3)
    env.reset(seed=7)
    envs.reset(seed=7)
    for _ in range(20):
        one, many = env.step([0.3]), envs.step(np.full((3, 1), 0.3))
    assert np.array_equal(one[0], many[0][0])
    assert one[1] == pytest.approx(many[1][0])


def test_from_rate_takes_a_rate_apart():
    system = ControlAffineSDE.from_rate(
        (x, v), (u, w), [v + w, sp.cos(x) * (u + 3) - (x + u) ** 2 + u**2 + 2 * x * u]
    )
    assert system.drift.equals(sp.Matrix([v, 3 * sp.cos(x) - x**2]))
    assert system.input_matrix.equals(sp.Matrix([[0, 1], [sp.cos(x), 0]]))
    assert not any(system.diffusion)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"barriers": x**2 - 1}, SystemDefinitionError, "wrong sign"),
        ({"start": [2.0, 0.0]}, SystemDefinitionError, "every start is unsafe"),
        ({"barriers": [1 - x**2, x - 3]}, SystemDefinitionError, "every start is unsafe: h_2"),
        ({"barriers": sp.Integer(1)}, RelativeDegreeError, "no relative degree"),
        ({"barriers": 1 - w**2}, SystemDefinitionError, "unknown symbol w"),
        ({"barriers": 1 - sp.sqrt(x - 5)}, SystemDefinitionError, "no finite value at the start"),
        ({"workspace": {x: (2.0, 3.0)}}, SystemDefinitionError, "outside the workspace"),
        (
            {"barriers": [x - 0.1, -0.2 - x]},
            SystemDefinitionError,
            "no start is safe for all barriers at once",
        ),
        ({"barriers": []}, SystemDefinitionError, "barriers is empty"),
        ({"barriers": 1 - x**2 > 0}, SystemDefinitionError, "give the expression itself"),
        ({"barriers": "1 - x**2"}, SystemDefinitionError, "give a sympy expression"),
        ({"barriers": sp.Min(1 - x, 1 - v)}, RelativeDegreeError, "different relative degrees"),
        ({"nominal": lambda state: -state}, SystemDefinitionError, "nominal is a function"),
        (
            {"nominal": sp.log(x - 5)},
            SystemDefinitionError,
            "the nominal controller has no finite value",
        ),
        ({"gains": (1.0,)}, SystemDefinitionError, "its relative degree is 2"),
        ({"gains": (1.0, -1.0)}, SystemDefinitionError, "as many positive numbers"),
        ({"gains": 2.0}, ConfigurationError, "give a tuple of rates"),
        ({"noise": 0.1}, ConfigurationError, "it names parameters of the diffusion"),
        ({"plane": ("x", "y")}, ConfigurationError, "it names states"),
        ({"states": (x,)}, ConfigurationError, "no further 'states'"),
        ({"filters": "scbf"}, ConfigurationError, "did you mean 'filter'"),
        ({"workspace": {"x": (-2.0, 3.0)}}, SystemDefinitionError, "give the symbol itself"),
        ({"start": [0.0]}, SystemDefinitionError, "2 states: x, v"),
        ({"start": [(0.0, math.inf), 0.0]}, ConfigurationError, "not finite"),
        ({"box": (1.0, -1.0)}, ConfigurationError, "the lower one below the upper"),
        ({"box": [(-1.0, 1.0), (-1.0, 1.0)]}, ConfigurationError, "give \\(low, high\\)"),
        ({"box": 3.0}, ConfigurationError, "give \\(low, high\\)"),
        ({"nominal": [u, u]}, SystemDefinitionError, "nominal expression for each of the 1 inputs"),
    ],
)
def test_mistakes_are_found_and_explained(change, error, says):
    with pytest.raises(error, match=says):
        stated(**change)


def test_an_input_that_does_nothing_is_found():
    system = ControlAffineSDE((x, v), (u, w), [v, 0], [[0, 0], [1, 0]], [0, 0])
    with pytest.raises(SystemDefinitionError, match="input w never appears"):
        stated(system)


def test_a_barrier_that_no_input_reaches_is_found():
    system = ControlAffineSDE((x, v), (u,), [-x, 0], [0, 1], [0, 0])
    with pytest.raises(RelativeDegreeError, match="no action can keep it positive"):
        stated(system)


@pytest.mark.parametrize("rate", [sp.sin(u), u**2, x * sp.Abs(u), 1 / (u + 2)])
def test_a_rate_that_is_not_affine_in_the_input_is_found(rate):
    with pytest.raises(SystemDefinitionError, match="the rate of v is not affine in the input u"):
        ControlAffineSDE.from_rate((x, v), (u,), [v, rate])


@pytest.mark.parametrize("rate", [sp.Piecewise((u + 1, u > 0), (u - 1, True)), x + sp.Heaviside(u)])
def test_a_rate_of_pieces_is_not_affine(rate):
    with pytest.raises(SystemDefinitionError, match="the rate of v is not affine in the input"):
        ControlAffineSDE.from_rate((x, v), (u,), [v, rate])


def test_a_rate_that_cannot_be_taken_apart_is_told_so():
    with pytest.raises(SystemDefinitionError, match="cancel what divides by an input"):
        ControlAffineSDE.from_rate((x,), (u,), [(u**2 + u) / u])
    with pytest.raises(SystemDefinitionError, match="give lists of symbols"):
        ControlAffineSDE.from_rate(x, u, [v])  # pyright: ignore[reportArgumentType]
    with pytest.raises(SystemDefinitionError, match="is no symbol"):
        ControlAffineSDE(("x",), (u,), [0], [1], [0])  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"box": (-500.0, 500.0), "workspace": {v: (-3.0, 3.0)}}, "across its whole workspace"),
        ({"nominal": -5000 * (x + 2)}, "check that both have the unit"),
        ({"box": (-1e-4, 1e-4), "start": [0.9, 0.9]}, "the input bounds are too narrow for h"),
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
        box=(990.0, 1010.0),
        workspace={v: (-50.0, 50.0)},
    )
    by_the_noise_alone = ControlAffineSDE((x, v), (u,), [-x, 0], [0, 1], [v, 0])
    assert len(stated(by_the_noise_alone).gains) == 2


def test_starts_are_in_the_workspace_and_where_the_system_has_a_value():
    system = ControlAffineSDE.from_rate((x,), (u,), [sp.sqrt(x) + u])
    problem = state_problem(
        system,
        x - 0.1,
        box=(-5, 5),
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
    assert stated(start=np.array([0.1, 0.0]), box=np.array([-5.0, 5.0])).box == ((-5.0, 5.0),)
    assert stated(start=np.array([[-0.1, 0.1], [0.0, 0.0]]), box=np.array([[-5.0, 5.0]])).box == (
        (-5.0, 5.0),
    )


def test_a_missing_parameter_and_a_symbol_of_other_assumptions_are_told_apart():
    with pytest.raises(SystemDefinitionError, match="gets its value in parameters"):
        ControlAffineSDE((x,), (u,), [k * x], [1], [0])
    with pytest.raises(SystemDefinitionError, match="x has other assumptions there"):
        ControlAffineSDE((x,), (u,), [sp.Symbol("x")], [1], [0])


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


def test_a_mistake_in_the_model_alone_is_found():
    system = ControlAffineSDE((x, v), (u,), [v, 0], [0, 1 / k], [0, 0], {k: 1.0})
    with pytest.raises(ConfigurationError, match="division by 0"):
        stated(system, model=system.with_parameters(k=0.0))


def test_gains_of_each_barrier_are_its_own():
    with pytest.raises(SystemDefinitionError, match="gains of h_2"):
        stated(barriers=[1 - x**2, 2 - v], gains=((1.0, 1.0), (1.0, 1.0)))


def test_boxes_without_zero_and_several_inputs_are_weighed_rightly():
    # Only u near 9 or above keeps the state: |u| alone would say that the box holds twice what is
    # needed.
    drift = ControlAffineSDE.from_rate((x,), (u, w), [u + w - 4000])
    with pytest.warns(SystemDefinitionWarning, match="the inputs make up 10"):
        state_problem(
            drift,
            x + 1,
            box=[(-30.0, 4.0), (-30.0, 6.0)],
            start=[0.0],
            dt=0.01,
            horizon=1.0,
            nominal=[0, 0],
        )
