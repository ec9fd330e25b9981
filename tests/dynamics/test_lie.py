"""Symbolic derivatives of every system, against finite differences in fifty digits."""

from __future__ import annotations

import itertools
import math

import mpmath
import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_envs import ControlAffineSDE, RelativeDegreeError, SystemDefinitionError, define_problem
from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.lie import (
    generator,
    lie_derivative_f,
    lie_derivative_g,
    quadratic_variation_rate,
    relative_degree,
    tidied,
    vanishes,
)
from safe_envs.dynamics.noise import StreamReader
from safe_envs.envs.simulation import Simulation
from tests.conftest import problem_of

OF_DEGREE_ONE = {"ACC", "Pendulum", "CubicSDE", "CubicSDEDisk", "Scalar"}


def in_fifty_digits(system, expression):
    return sp.lambdify([system.states], system.exact(expression), "mpmath", cse=True)


def states_near_starts(problem, count=2):
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
    F = sp.Matrix([[1, 2, 0], [0, -1, 3], [1, 0, 2]])
    P = sp.Matrix([[2, 1, -1], [1, 3, 2], [-1, 2, 1]])
    S = sp.Matrix([[1, 2], [3, -1], [0, 4]])
    x = sp.Matrix(sp.symbols("x_1:4", real=True))
    system = ControlAffineSDE(tuple(x), (sp.Symbol("u", real=True),), list(F * x), [0, 0, 1], S)
    form, phi = P, (x.T * P * x)[0, 0]
    variance = quadratic_variation_rate(system, phi) - 4 * (x.T * P * S * S.T * P * x)[0, 0]
    assert sp.expand(variance) == 0
    for _ in range(2):
        constant = (form * S * S.T).trace()
        form = F.T * form + form * F
        phi = generator(system, phi)
        assert sp.expand(phi - (x.T * form * x)[0, 0] - constant) == 0


def test_relative_degrees_of_the_registered_systems(env_id):
    problem = problem_of(env_id, noise=0.3)
    name = env_id.removeprefix("safe_envs/").removesuffix("-v0")
    expected = 1 if name in OF_DEGREE_ONE else 2
    for i, barrier in enumerate(problem.barriers):
        assert relative_degree(problem.plant, barrier.expression) == expected
        assert relative_degree(problem.plant, barrier.expression, generator) == expected
        assert len(problem.gains_of(i)) == expected


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_degree_of_a_chain_of_integrators_is_its_length(count):
    x = sp.symbols(f"x_1:{count + 1}", real=True)
    matrices = [*x[1:], 0], [0] * (count - 1) + [1], [0] * count
    system = ControlAffineSDE(x, sp.symbols("u", real=True, seq=True), *matrices)
    assert relative_degree(system, x[0]) == count
    assert relative_degree(system, x[0] ** 3 + sp.sin(x[0]), generator) == count


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


X, Y, U = sp.symbols("x y u", real=True)
A, B, C = sp.symbols("a b c", real=True)


def test_an_input_that_never_appears_is_an_error():
    system = ControlAffineSDE((X, Y), (U,), [-X, 0], [0, 1], [0, 0])
    with pytest.raises(RelativeDegreeError, match="no input \\(u\\) appears"):
        relative_degree(system, 1 - X**2)
    with pytest.raises(SystemDefinitionError, match="unknown symbol q"):
        relative_degree(system, sp.Symbol("q"))


@pytest.mark.parametrize(
    ("gain", "c", "degree"),
    [
        # In binary, .1 + .2 - .3 is not 0; the designer means that it is.
        (A + B - C, 0.3, 2),
        (A + B - C, 0.31, 1),
        (sp.sin(X) ** 2 + sp.cos(X) ** 2 - 1, 1.0, 2),
    ],
)
def test_a_gain_that_is_zero_in_disguise_leaves_no_false_degree(gain, c, degree):
    parameters = {A: 0.1, B: 0.2, C: c}
    system = ControlAffineSDE((X, Y), (U,), [Y, 0], [gain, 1], [0, 0], parameters)
    assert relative_degree(system, X) == degree


def test_an_exponential_is_not_taken_apart():
    # exp(10000 x) exp(-10000 x^2) has no finite value where the bump has one.
    x, v, u = sp.symbols("x v u", real=True)
    bump = 1 - sp.exp(-1e4 * (x - sp.Rational(1, 2)) ** 2)
    system = ControlAffineSDE((x, v), (u,), [v, 0], [0, bump], [[0], [0]])
    effect = compile_function((x, v), [tidied(lie_derivative_g(system, 1 - v**2)[0])], "floats")
    assert effect(0.0840945, 0.158771)[0] == pytest.approx(-2 * 0.158771, rel=1e-15)


# Formulas that are zero everywhere are told from those that are zero in places only.


x, y, u, sigma = sp.symbols("x y u sigma", real=True)

ZERO = {
    "squares": sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1,
    "hyperbolic": sp.cosh(x * y) ** 2 - sp.sinh(x * y) ** 2 - 1,
    "saturated": (1 - sp.tanh(1000 * x)) * (1 + sp.tanh(1000 * x)) - sp.sech(1000 * x) ** 2,
    "maximum and minimum": sp.Max(x, y) + sp.Min(x, y) - x - y,
    "size": sp.Max(x, -x) - sp.Abs(x),
    "size by pieces": sp.Piecewise((x, x > 0), (-x, True)) - sp.Abs(x),
    "step": sp.Heaviside(x - 300) + sp.Heaviside(300 - x) - 1,
    "pieces": sp.Piecewise(
        (0, sp.Or(x < 500, x > 600)), (sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1, True)
    ),
    "conditions": sp.Piecewise((1, sp.And(x > 1, sp.Not(y > 1))), (0, True))
    - sp.Heaviside(x - 1) * sp.Heaviside(1 - y),
    "a product of roots": (sp.sqrt(x**2 + y**2) - 1) * (sp.sqrt(x**2 + y**2) + 1) - x**2 - y**2 + 1,
    "floats": (0.1 * x + 0.2) ** 2 - 0.01 * x**2 - 0.04 * x - 0.04,
    "with an unknown function": (sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1)
    * sp.log(1 + x**2)
    * sp.floor(x),
}  # fmt: skip

NOT_ZERO = {
    "beyond 2": sp.Max(x - 2, 0),
    "beyond a million": sp.Max(x - 10**6, 0) ** 2,
    "below": sp.Min(x + 1000, 0),
    "a piece far away": sp.Piecewise((0, x < 5000), (1, True)),
    "a hidden kink": sp.sqrt(2 - 2 * sp.cos(x)) - 2 * sp.sin(x / 2),
    "a hidden kink far away": sp.sqrt(x**2 - 2 * 10**4 * x + 10**8) + x - 10**4,
    "another branch": sp.atan(1 / x) + sp.atan(x) - sp.pi / 2,
    "sawtooth": sp.asin(sp.sin(x)) - x,
    "a saturated switch far away": 1 + sp.tanh(10**6 * (x - 5)),
    "a saturated integral far away": 1 + sp.erf(10**3 * (x - 5)),
    "a high power": (1 + (x / 5) ** 2000) ** 2 - 1,
    "a rounded corner far away": sp.sqrt((x - 5) ** 2 + sp.Rational(1, 10**300)) + x - 5,
    "a logistic switch": 1 / (1 + sp.exp(10**3 * (x - 5))) - 1,
    "tiny": sp.exp(-1000 * (2 + sp.cos(x))),
    "floor": sp.floor(x / 10**6),
    "impulse": sp.DiracDelta(x - 7),
    "unknown": sp.Function("f")(x).diff(x),
}


@pytest.mark.parametrize(
    ("expression", "zero"),
    [
        *(pytest.param(e, True, id=name) for name, e in ZERO.items()),
        *(pytest.param(e, False, id=name) for name, e in NOT_ZERO.items()),
    ],
)
def test_what_is_zero_in_places_only_is_not_zero(expression, zero):
    assert is_zero(expression) == zero


KINKS = st.lists(
    st.tuples(st.integers(-50, 50), st.integers(-9, 9)),
    min_size=1,
    max_size=4,
    unique_by=lambda kink: kink[0],
)


@given(KINKS, st.booleans())
@settings(max_examples=20)
def test_a_piecewise_linear_function_is_zero_where_its_values_are(kinks, differently):
    """Write sum c max(x - k, 0) again by sizes; values at the kinks and between tell whether both
    are the same."""
    written = sum(c * sp.Max(x - k, 0) for k, c in kinks)
    again = sum(
        sp.Rational(c, 2) * (x - k + sp.Abs(x - k)) for k, c in kinks[1 if differently else 0 :]
    )
    at = [-1000, 1000, *[k + d for k, _ in kinks for d in (-1, 0, 1)]]
    same = all((written - again).subs(x, value) == 0 for value in at)
    assert is_zero(written - again) == same


def noisy(diffusion, gain=1):
    return ControlAffineSDE((x, y), (u,), [0, 0], [gain, 1], [diffusion, 0], {sigma: 0.3})


def test_noise_in_a_part_of_the_workspace_reaches_a_barrier():
    start = {"input_bounds": (-1, 1), "start": [0.0, 0.0], "dt": 0.1, "horizon": 1.0}
    for diffusion in (
        sp.Max(x - 2, 0),
        sp.Piecewise((0, x < 50), (sigma, True)),
        sigma * sp.Heaviside(-x - 1),
    ):
        bridge = BrownianBridge(define_problem(noisy(diffusion), [5 - x, 5 - y], **start))
        assert bridge.reached == (True, False)
    bridge = BrownianBridge(define_problem(noisy(sp.Max(x - 2, 0)), 5 - x, **start))
    states, ends = (np.array([1.0, 3.0]), np.zeros(2)), np.array([[0.2], [0.2]])
    # With h = 0.2 at both ends and E = 1 the smallest h is (0.4 - sqrt(2 s^2 dt))/2, s = max(x - 2,
    # 0).
    expected = [0.2, 0.5 * (0.4 - math.sqrt(2 * 0.1))]
    found = bridge.sample_minimum(states, ends, ends, np.ones((2, 1)))[:, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_an_input_that_counts_in_a_part_of_the_workspace_counts():
    for gain in (
        sp.Max(x - 2, 0),
        sp.Piecewise((0, x < 50), (1, True)),
        sp.sqrt(2 - 2 * sp.cos(x)) - 2 * sp.sin(x / 2),
    ):
        assert relative_degree(noisy(0, gain), 5 - x) == 1
    with pytest.raises(RelativeDegreeError):
        relative_degree(noisy(0, sp.Max(x, 0) + sp.Min(x, 0) - x), 5 - x)


def test_parameters_count_with_their_decimal_values():
    assert vanishes(noisy(sigma), sigma * x - sp.Rational(3, 10) * x)
    assert not vanishes(noisy(sigma), sigma * x - sp.Rational(1, 3) * x)
