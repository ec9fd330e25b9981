"""Symbolic derivatives of every system, against finite differences in fifty digits."""

from __future__ import annotations

import itertools

import mpmath
import numpy as np
import pytest
import sympy as sp

import safe_envs
from safe_envs import ControlAffineSDE, RelativeDegreeError, SystemDefinitionError
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import (
    derivatives,
    generator,
    lie_derivative_f,
    lie_derivative_g,
    quadratic_variation_rate,
    relative_degree,
    tidied,
)
from safe_envs.dynamics.noise import StreamReader
from safe_envs.envs.simulation import Simulation
from tests.conftest import problem_of

DEGREES = {
    "DubinsDisk": 2, "DubinsObstacle": 2, "DubinsObstacles": 2, "DubinsReach": 2,
    "StochasticDubins": 2,
    "QuadrotorAltitude": 2, "Quadrotor": 2, "QuadrotorLimits": 2,
    "ACC": 1, "ACCGap": 2, "Pendulum": 1, "CubicSDE": 1, "CubicSDEDisk": 1, "Scalar": 1,
}  # fmt: skip


def in_fifty_digits(system, expression):
    return sp.lambdify([system.states], system.exact(expression), "mpmath")


def states_near_starts(problem, count=4):
    simulation = Simulation(problem, "floats")
    reader, rng = StreamReader(), np.random.default_rng(0)
    starts = [simulation.starts.draw(reader, (0, 0), i) for i in range(count)]
    return [
        [mpmath.mpf(c) for c in np.add(start, 0.3 * rng.normal(size=problem.plant.n))]
        for start in starts
    ]


def moved(x, direction, step):
    return [a + step * d for a, d in zip(x, direction, strict=True)]


def levels_of(problem, system):
    """For each barrier, and each time that the generator is applied up to its degree: phi, its Lie
    derivatives and A phi."""
    for barrier in problem.barriers:
        phi = barrier.expression
        for _ in range(relative_degree(system, phi, generator)):
            generated = generator(system, phi)
            exact = [lie_derivative_f(system, phi), *lie_derivative_g(system, phi)]
            yield (
                in_fifty_digits(system, phi),
                [in_fifty_digits(system, e) for e in exact],
                in_fifty_digits(system, generated),
            )
            phi = generated


def test_derivatives_equal_finite_differences(env_id):
    problem = problem_of(env_id, noise=0.3)
    with mpmath.workdps(60):
        for system in dict.fromkeys((problem.plant, problem.model)):
            assert_derivatives(problem, system)


def assert_derivatives(problem, system):
    step = mpmath.mpf("1e-12")
    f, g, sigma = (
        in_fifty_digits(system, m) for m in (system.drift, system.input_matrix, system.diffusion)
    )
    states = states_near_starts(problem)
    directions = [
        [[values[:, j] for j in range(values.cols)] for values in (m(x) for m in (f, g, sigma))]
        for x in states
    ]
    for (at, exact, generated), (x, (drift, effects, noises)) in itertools.product(
        levels_of(problem, system), zip(states, directions, strict=True)
    ):
        slopes = [
            (at(moved(x, d, step)) - at(moved(x, d, -step))) / (2 * step)
            for d in (*drift, *effects)
        ]
        curvature = sum(
            (at(moved(x, s, step)) - 2 * at(x) + at(moved(x, s, -step))) / step**2 for s in noises
        )
        for slope, derivative in zip(slopes, exact, strict=True):
            assert abs(slope - derivative(x)) < mpmath.mpf("1e-9") * (1 + abs(slope))
        a_phi = slopes[0] + curvature / 2
        assert abs(a_phi - generated(x)) < mpmath.mpf("1e-9") * (1 + abs(a_phi))


def correlated() -> ControlAffineSDE:
    """Three states that share two channels of noise, of sizes that depend on the state."""
    a, b, c, u = sp.symbols("a b c u", real=True)
    sigma = [[1 + b**2, sp.sin(c)], [a * c, sp.Rational(1, 2)], [sp.cos(a), -b]]
    return ControlAffineSDE((a, b, c), (u,), [b, -a * c, sp.sin(a)], [0, 0, 1], sigma)


def coin_tosses(system, phi, x, dt):
    """Mean and mean square of the change of phi by x + f dt + sigma dW, where each dW is +sqrt(dt)
    or -sqrt(dt), over dt.

    Tosses have the mean and the covariance of dW, which is all of it that counts as dt -> 0.
    """
    f, sigma = (
        in_fifty_digits(system, system.drift)(x),
        in_fifty_digits(system, system.diffusion)(x),
    )
    changes = []
    for signs in itertools.product((-1, 1), repeat=system.diffusion.cols):
        noise = [
            mpmath.sqrt(dt) * sum(s * sigma[i, j] for j, s in enumerate(signs))
            for i in range(system.n)
        ]
        changes.append(phi([x[i] + f[i] * dt + noise[i] for i in range(system.n)]) - phi(x))
    return (
        sum(changes) / len(changes) / dt,
        sum(change**2 for change in changes) / len(changes) / dt,
    )


def test_correlated_noise_enters_the_generator_and_the_spread():
    system = correlated()
    a, b, c = system.states
    phi = a**2 * b + 3 * b * c + sp.sin(a * c)
    with mpmath.workdps(60):
        for _ in range(2):
            exact, generated, square = (
                in_fifty_digits(system, e)
                for e in (phi, generator(system, phi), quadratic_variation_rate(system, phi))
            )
            for x in ([0.3, -1.2, 0.8], [1.7, 0.4, -0.6]):
                x = [mpmath.mpf(entry) for entry in x]
                rate, variance = coin_tosses(system, exact, x, mpmath.mpf("1e-20"))
                assert abs(rate - generated(x)) < mpmath.mpf("1e-12") * (1 + abs(rate))
                assert abs(variance - square(x)) < mpmath.mpf("1e-12") * (1 + abs(variance))
            # The second time it is the generator of the generator.
            phi = generator(system, phi)


def test_a_quadratic_form_under_correlated_noise():
    # A x'Px = x'(F'P + PF)x + tr(P S S') for dx = Fx dt + S dW, and so on for the form of F'P + PF.
    F, P = (
        sp.Matrix([[1, 2, 0], [0, -1, 3], [1, 0, 2]]),
        sp.Matrix([[2, 1, -1], [1, 3, 2], [-1, 2, 1]]),
    )
    S = sp.Matrix([[1, 2], [3, -1], [0, 4]])
    x = sp.Matrix(sp.symbols("x_1:4", real=True))
    system = ControlAffineSDE(tuple(x), (sp.Symbol("u", real=True),), list(F * x), [0, 0, 1], S)
    form, constant, phi = P, sp.Integer(0), (x.T * P * x)[0, 0]
    for _ in range(2):
        constant = (form * S * S.T).trace()
        form = F.T * form + form * F
        phi = generator(system, phi)
        assert sp.expand(phi - (x.T * form * x)[0, 0] - constant) == 0
    assert (
        sp.expand(
            quadratic_variation_rate(system, (x.T * P * x)[0, 0])
            - 4 * (x.T * P * S * S.T * P * x)[0, 0]
        )
        == 0
    )


def test_relative_degrees_of_the_registered_systems(env_id):
    problem = problem_of(env_id, noise=0.3)
    expected = DEGREES[env_id.removeprefix("safe_envs/").removesuffix("-v0")]
    for i, barrier in enumerate(problem.barriers):
        assert relative_degree(problem.plant, barrier.expression) == expected
        assert relative_degree(problem.plant, barrier.expression, generator) == expected
        assert len(problem.gains_of(i)) == expected


def test_degrees_are_listed_for_every_id():
    assert {f"safe_envs/{name}-v0" for name in DEGREES} == set(safe_envs.ENV_IDS)


def integrators(count, **changes):
    """x_1' = x_2, ..., x_n' = u."""
    x = sp.symbols(f"x_1:{count + 1}", real=True)
    arguments = {
        "states": x, "inputs": sp.symbols("u", real=True, seq=True), "drift": [*x[1:], 0],
        "input_matrix": [0] * (count - 1) + [1], "diffusion": [0] * count, **changes,
    }  # fmt: skip
    return ControlAffineSDE(**arguments)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_degree_of_a_chain_of_integrators_is_its_length(count):
    system = integrators(count)
    assert relative_degree(system, system.states[0]) == count
    assert (
        relative_degree(system, system.states[0] ** 3 + sp.sin(system.states[0]), generator)
        == count
    )


def test_noise_can_lower_the_degree():
    # dx_1 = x_3 dt + x_2 dW, dx_2 = u dt, dx_3 = x_1 dt: the input reaches x_1 through the size of
    # its noise alone, A x_1^2 = 2 x_1 x_3 + x_2^2.
    x1, x2, x3, u = sp.symbols("x1 x2 x3 u", real=True)
    system = ControlAffineSDE((x1, x2, x3), (u,), [x3, 0, x1], [0, 1, 0], [x2, 0, 0])
    assert relative_degree(system, x1**2, generator) == 2
    with pytest.raises(RelativeDegreeError, match="no input"):
        relative_degree(system, x1**2, lie_derivative_f)


def test_stochastic_degree_may_exceed_the_number_of_states():
    x1, x2, u = sp.symbols("x1 x2 u", real=True)
    system = ControlAffineSDE((x1, x2), (u,), [x1**2, 0], [0, 1], [x2, 0])
    assert relative_degree(system, 1 - x1, generator) == 3


def test_input_that_never_appears_is_an_error():
    x, y, u = sp.symbols("x y u", real=True)
    system = ControlAffineSDE((x, y), (u,), [-x, 0], [0, 1], [0, 0])
    with pytest.raises(RelativeDegreeError, match="no input \\(u\\) appears"):
        relative_degree(system, 1 - x**2)


def test_cancelling_parameters_leave_no_false_degree():
    # In binary, .1 + .2 - .3 is not 0; the designer means that it is.
    x, y, u, a, b, c = sp.symbols("x y u a b c", real=True)
    system = ControlAffineSDE(
        (x, y), (u,), [y, 0], [a + b - c, 1], [0, 0], {a: 0.1, b: 0.2, c: 0.3}
    )
    assert relative_degree(system, x) == 2
    assert relative_degree(system.with_parameters(c=0.31), x) == 1


def test_hidden_zero_is_seen_without_simplification():
    x, y, u = sp.symbols("x y u", real=True)
    system = ControlAffineSDE(
        (x, y), (u,), [y, 0], [sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1, 1], [0, 0]
    )
    assert relative_degree(system, x) == 2


def test_barrier_of_unknown_symbols_is_refused():
    system = integrators(2)
    with pytest.raises(SystemDefinitionError, match="unknown symbol q"):
        relative_degree(system, sp.Symbol("q"))


# What the thesis prints, where it is right, and what it should have printed, where it is not.


def same(system, ours, theirs):
    return sp.simplify(system.exact(ours - theirs)) == 0


def named(problem):
    system = problem.model
    return {s.name: s for s in (*system.states, *system.inputs, *system.parameters)}


def test_dubins_disk_as_printed():
    problem = problem_of("safe_envs/DubinsDisk-v0")
    s, system, h = named(problem), problem.model, problem.barriers[0].expression
    _, lf, lf2 = derivatives(system, h, 2, lie_derivative_f)
    cos, sin = sp.cos(s["theta"]), sp.sin(s["theta"])
    assert same(system, lf, -2 * s["v"] * (s["x"] * cos + s["y"] * sin))
    assert same(system, lf2, -2 * s["v"] ** 2)
    assert same(
        system, lie_derivative_g(system, lf)[0], -2 * s["v"] * (s["y"] * cos - s["x"] * sin)
    )


def test_moving_obstacle_keeps_the_velocity_that_the_print_forgets():
    problem = problem_of("safe_envs/DubinsObstacle-v0")
    s, system, h = named(problem), problem.model, problem.barriers[0].expression
    x_o, y_o = system.states[3:]
    _, lf, lf2 = derivatives(system, h, 2, lie_derivative_f)
    dx, dy = s["x"] - x_o, s["y"] - y_o
    cos, sin, v, v_o = sp.cos(s["theta"]), sp.sin(s["theta"]), s["v"], s["v_o"]
    assert same(system, lf, 2 * v * (dx * cos + dy * sin) - 2 * v_o * dx)
    assert same(system, lf2, 2 * v**2 - 4 * v * v_o * cos + 2 * v_o**2)


def test_altitude_with_the_signs_of_the_print_corrected():
    problem = problem_of("safe_envs/QuadrotorAltitude-v0")
    system, h = problem.model, problem.barriers[0].expression
    s = named(problem)
    z, zdot = system.states
    e = z - 5
    _, lf, lf2 = derivatives(system, h, 2, lie_derivative_f)
    assert same(system, lf, -4 * e**3 * zdot / 16)
    printed = -4 * e**3 * s["g"] / 16 - 12 * e**2 * zdot / 16
    corrected = 4 * e**3 * s["g"] / 16 - 12 * e**2 * zdot**2 / 16
    assert same(system, lf2, corrected)
    assert not same(system, lf2, printed)
    assert same(system, lie_derivative_g(system, lf)[0], -4 * e**3 / (16 * s["m"]))


def test_pendulum_as_printed():
    problem = problem_of("safe_envs/Pendulum-v0")
    system, h = problem.model, problem.barriers[0].expression
    th, om = system.states
    root = sp.sqrt(3)
    lf = -(2 * root * th + 2 * om) * om - (2 * th + 2 * root * om) * sp.Rational(100, 7) * sp.sin(
        th
    )
    rows = [
        (lie_derivative_f(system, h), lf),
        (lie_derivative_g(system, h)[0], -(2 * th + 2 * root * om) / sp.Rational(49, 100)),
        (generator(system, h) - lie_derivative_f(system, h), -root * (th / 10) ** 2),
    ]
    for ours, theirs in rows:
        difference = sp.lambdify((th, om), system.exact(ours - theirs))
        assert abs(difference(0.7, -0.4)) < 1e-9


def test_cubic_generators():
    parabola, disk = problem_of("safe_envs/CubicSDE-v0"), problem_of("safe_envs/CubicSDEDisk-v0")
    x1, x2 = parabola.model.states
    a_h = generator(parabola.model, parabola.barriers[0].expression)
    assert same(parabola.model, a_h, sp.Rational(6, 10) * x1 + x2 - 2 * x1**3 * x2 - (x2 / 10) ** 2)
    # The print has x1 x2 for 2 x1 x2, and sigma_2 twice.
    a_h = generator(disk.model, disk.barriers[0].expression)
    assert same(
        disk.model,
        a_h,
        sp.Rational(12, 10) * x1**2 + 2 * x1 * x2 - 2 * x1**3 * x2 - sp.Rational(8, 100),
    )


def test_cruise_generators():
    problem = problem_of("safe_envs/ACC-v0")
    system, s = problem.model, named(problem_of("safe_envs/ACC-v0"))
    drag = s["f_0"] + s["f_1"] * s["x_1"] + s["f_2"] * s["x_1"] ** 2
    tau = sp.Rational(9, 5)
    h = problem.barriers[0].expression
    assert same(
        system, sp.nsimplify(generator(system, h)), s["x_2"] - s["x_1"] + tau * drag / s["M"]
    )
    assert same(system, sp.nsimplify(lie_derivative_g(system, h)[0]), -tau / s["M"])
    assert same(system, generator(system, h), lie_derivative_f(system, h))


def test_gap_generators_with_the_terms_of_the_print_corrected():
    problem = problem_of("safe_envs/ACCGap-v0")
    system, s = problem.model, named(problem)
    y, d = s["z"] - 10, s["v_f"] - s["v"]
    drag = s["f_0"] + s["f_1"] * s["v"] + s["f_2"] * s["v"] ** 2
    s2 = s["sigma_2"]
    _, b1, b2 = derivatives(system, sp.nsimplify(problem.barriers[0].expression), 2, generator)
    assert same(system, b1, 5 * y**4 * d + 10 * s2**2 * y**3)
    assert same(
        system,
        b2,
        20 * y**3 * d**2 + 60 * s2**2 * y**2 * d + 5 * y**4 * drag / s["M"] + 30 * s2**4 * y,
    )
    assert same(system, lie_derivative_g(system, b1)[0], -5 * y**4 / s["M"])


def test_scalar_generator():
    problem = problem_of("safe_envs/Scalar-v0")
    system = problem.model
    assert same(system, generator(system, problem.barriers[0].expression), -system.states[0])


def test_an_exponential_is_not_taken_apart():
    # exp(10000 x) exp(-10000 x^2) has no finite value where the bump has one.
    x, v, u = sp.symbols("x v u", real=True)
    bump = 1 - sp.exp(-1e4 * (x - sp.Rational(1, 2)) ** 2)
    system = ControlAffineSDE((x, v), (u,), [v, 0], [0, bump], [[0], [0]])
    effect = compile_function((x, v), [tidied(lie_derivative_g(system, 1 - v**2)[0])], "floats")
    assert effect(0.0840945, 0.158771)[0] == pytest.approx(-2 * 0.158771, rel=1e-15)
