"""Filters as layers of a torch network: values of `SafetyFilter`, and gradients as its finite
differences are."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
import torch

from safe_envs import Barrier, ConfigurationError, ControlAffineSDE, InvalidInputError
from safe_envs.agents import make_problem
from safe_envs.filters import torch_layer
from safe_envs.filters.torch_layer import TorchFilter
from safe_envs.wrappers import CBF, SafetyFilter, parse_conditions
from tests.values.guesses import guess

pytestmark = pytest.mark.slow

FILTERS = {
    "scbf, m = 1": ("StochasticDubins", "scbf"),
    "scbf, m = 4": ("Quadrotor", "scbf"),
    "five rows, m = 1": ("DubinsObstacles", "scbf"),
    "three rows, m = 4": ("QuadrotorLimits", "scbf"),
}


def visited(env_id, count):
    """States that random actions lead to."""
    env = gym.make(env_id)
    env.action_space.seed(0)
    env.reset(seed=0)
    states = []
    for _ in range(count):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        states.append(env.unwrapped.state)  # pyright: ignore[reportAttributeAccessIssue]
        if terminated or truncated:
            env.reset()
    return np.array(states)


@pytest.fixture(scope="module", params=FILTERS)
def registered(request):
    """A filter of a registered env, states on its way and inputs that leave the box sometimes."""
    name, condition = FILTERS[request.param]
    problem = make_problem(f"safe_envs/{name}-v0")
    module = TorchFilter.for_problem(problem, parse_conditions(condition, problem))
    rng = np.random.default_rng(1)
    low, high = np.array(problem.input_bounds).T
    x = visited(f"safe_envs/{name}-v0", 200) + 0.05 * rng.normal(size=(200, problem.model.n))
    return (
        module,
        x,
        rng.uniform(1.2 * low - 0.2 * high, 1.2 * high - 0.2 * low, (200, problem.model.m)),
    )


def planar(m, k, *, contradicting=False, seed=0):
    """k curved rows on m inputs with all that a filter can weigh; pairs of contradicting ones have
    opposite coefficients."""
    rng = np.random.default_rng(seed)
    x, u = sp.symbols("x:2", real=True), sp.symbols(f"u:{m}", real=True)

    def number():
        return round(float(rng.normal()), 3)

    drift = [number() * sp.sin(x[1]), number() * x[0]]
    inputs = [[number() + number() * x[1 - i] for _ in range(m)] for i in range(2)]
    barriers = [number() * x[0] + number() * x[1] ** 2 + 1.0 for _ in range(k)]
    if contradicting:
        barriers[1] = -barriers[0] - 2
    model = ControlAffineSDE(x, u, drift, inputs, [[0]] * 2)
    rows = [(Barrier(h, f"h{i}"), CBF(alpha=1.0)) for i, h in enumerate(barriers)]
    return SafetyFilter(
        model,
        rows,
        input_bounds=[(-1.0, 1.5)] * m,
        weights=rng.uniform(0.3, 3.0, m),
        priorities=rng.uniform(0.3, 3.0, k),
    )


def differences(safety_filter, x, u, step):
    """Central differences of the action by state and input, shape (m, n + m)."""
    z = np.concatenate([x, u])
    points = np.concatenate([z + step * np.eye(len(z)), z - step * np.eye(len(z))])
    ahead, behind = np.split(
        safety_filter.filter(points[:, : len(x)], points[:, len(x) :]).action, 2
    )
    return (ahead - behind).T / (2.0 * step)


def jacobian(module, x, u):
    parts = torch.autograd.functional.jacobian(module, (torch.tensor(x), torch.tensor(u)))
    return np.concatenate([part.numpy() for part in parts], axis=1)


def assert_slopes(module, x, u, step=1e-5, tolerance=1e-3):
    """Compare the gradients of states where differences do not see a kink, and return how many
    these are."""
    count = 0
    for xi, ui in zip(x, u, strict=True):
        wanted, check = [differences(module.safety_filter, xi, ui, s) for s in (step, step / 2.0)]
        room = tolerance * (1.0 + np.abs(wanted).max())
        if np.abs(wanted - check).max() < room:
            assert np.abs(jacobian(module, xi, ui) - wanted).max() < room
            count += 1
    return count


def test_values_and_flags_are_those_of_the_filter(registered):
    module, x, u = registered
    wanted = module.safety_filter.filter(x, u)
    found = module(torch.tensor(x, requires_grad=True), torch.tensor(u), return_result=True)
    np.testing.assert_array_equal(found.action.detach().numpy(), wanted.action)
    np.testing.assert_array_equal(found.feasible.numpy(), wanted.feasible)
    np.testing.assert_array_equal(found.active.numpy(), wanted.active)
    with torch.no_grad():
        stacked = module(torch.tensor(x).reshape(4, 50, -1), torch.tensor(u).reshape(4, 50, -1))
    np.testing.assert_array_equal(stacked.numpy().reshape(u.shape), wanted.action)


def test_gradients_pass_gradcheck(registered):
    module, x, u = registered
    decided = module.safety_filter.filter(x, u)
    acting = decided.active.any(axis=-1)
    chosen = np.concatenate(
        [np.flatnonzero(mask)[:3] for mask in (~acting, acting & decided.feasible)]
    )
    assert acting[chosen].any()
    # In units of the box, so that an error is judged by what the inputs can do.
    unit = np.abs(u).max()
    for i in chosen:
        given = [torch.tensor(part, requires_grad=True) for part in (x[i], u[i] / unit)]
        assert torch.autograd.gradcheck(
            lambda x, u: module(x, unit * u) / unit, given, eps=1e-4, atol=1e-3, rtol=1e-3
        )


@pytest.mark.parametrize("most", [12, pytest.param(60, marks=pytest.mark.oracle)])
@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize("k", [1, 3])
def test_slopes_are_the_differences_of_the_filter(m, k, most):
    module = TorchFilter(planar(m, k, seed=m))
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(60, 2)), 1.5 * rng.normal(size=(60, m))
    acting = module.safety_filter.filter(x, u).active.any(axis=-1)
    assert np.count_nonzero(acting) > 10
    chosen = np.concatenate([np.flatnonzero(part)[:most] for part in (acting, ~acting)])
    assert assert_slopes(module, x[chosen], u[chosen]) > 0.9 * len(chosen)


@pytest.mark.parametrize("size", [16, pytest.param(100, marks=pytest.mark.oracle)])
@pytest.mark.parametrize("m", [1, 2, 4])
def test_slopes_of_a_compromise(m, size):
    module = TorchFilter(planar(m, 3, contradicting=True, seed=3))
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(size, 2)), 1.5 * rng.normal(size=(size, m))
    assert not module.safety_filter.filter(x, u).feasible.any()
    assert assert_slopes(module, x, u) > 0.75 * size
    given = [torch.tensor(part, requires_grad=True) for part in (x, u)]
    result = module(*given, return_result=True)
    assert result.differentiable.all()
    assert all(part.isfinite().all() for part in torch.autograd.grad(result.action.sum(), given))


def test_the_flag_of_gradients_does_not_hang_on_whether_one_was_asked_for(monkeypatch):
    # No formula is exact to the last bit: so some are said not to agree.
    monkeypatch.setattr(torch_layer, "_AGREED", 0.0)
    module = TorchFilter(planar(4, 2, contradicting=True, seed=3))
    rng = np.random.default_rng(0)
    x, u = (torch.tensor(rng.normal(size=(150, size))) for size in (2, 4))
    given = x.clone().requires_grad_(), u.clone().requires_grad_()
    wanted = module(*given, return_result=True)
    plain = module(x, u, return_result=True)
    with torch.no_grad():
        unasked = module(x, u.clone().requires_grad_(), return_result=True)
    assert 0 < torch.count_nonzero(wanted.differentiable) < 150
    slopes = torch.cat(torch.autograd.grad(wanted.action.sum(), given), dim=1)
    assert torch.count_nonzero(slopes[~wanted.differentiable]) == 0
    for found in (plain, unasked):
        assert torch.equal(found.differentiable, wanted.differentiable)
        assert torch.equal(found.action, wanted.action)
        assert not found.action.requires_grad


def test_second_derivatives():
    module = TorchFilter(planar(2, 3, seed=2))
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(60, 2)), rng.normal(size=(60, 2))
    decided = module.safety_filter.filter(x, u)
    for i in np.flatnonzero(decided.active.any(axis=-1) & decided.feasible)[:4]:
        given = [torch.tensor(part[i], requires_grad=True) for part in (x, u)]
        assert torch.autograd.gradgradcheck(module, given, atol=1e-4)


def test_floats_of_less_precision_are_computed_in_double():
    problem = make_problem("safe_envs/StochasticDubins-v0")
    module = TorchFilter.for_problem(problem, "scbf")
    x = torch.tensor([0.5, 2.5, 1.2])
    u = torch.tensor([-1.0], requires_grad=True)
    action = module(x, u)
    assert action.dtype == torch.float32
    wanted = module.safety_filter.filter(x.double().numpy(), u.detach().double().numpy()).action
    assert action.item() == np.float32(wanted[0])
    action.sum().backward()
    assert u.grad is not None
    assert u.grad.dtype == torch.float32
    assert module(x.double(), u).dtype == torch.float32


def of_dubins(x, u=(0.5,)):
    given = [torch.tensor(part) if isinstance(part, list | tuple) else part for part in (x, u)]
    return TorchFilter.for_problem(make_problem("safe_envs/StochasticDubins-v0"), "scbf")(*given)


@pytest.mark.parametrize(
    ("x", "fragment"),
    [
        ([0, 0, 0], "int64"),
        ([0.5, 2.5], "do not fit"),
        ([0.5, math.nan, 0.0], "finite"),
        *((wrong, "give") for wrong in (None, "text", np.zeros(3), torch.zeros(3) + 0j)),
    ],
)
def test_what_is_no_state_is_refused(x, fragment):
    with pytest.raises(InvalidInputError, match=fragment):
        of_dubins(x)
    if fragment == "give":
        with pytest.raises(InvalidInputError, match=fragment):
            of_dubins([0.5, 2.5, 1.2], x)


def test_where_no_row_acts_the_slope_is_that_of_the_proposal():
    """Also at its bounds, which it can leave."""
    module = TorchFilter(planar(2, 1))
    x = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    u = torch.tensor([1.5, -1.0], dtype=torch.float64, requires_grad=True)
    by_state, by_input = torch.autograd.grad(module(x, u).sum(), (x, u))
    assert by_state.tolist() == [0.0, 0.0]
    assert by_input.tolist() == [1.0, 1.0]


def test_rows_of_functions_with_kinks():
    x, y, u = sp.symbols("x y u", real=True)
    model = ControlAffineSDE(
        (x, y),
        (u,),
        [sp.Max(y, 0.5) + sp.Piecewise((0.1, x < 0), (0.3 * y, True)), -sp.Abs(y)],
        [[1], [0]],
        [[0], [0]],
    )
    module = TorchFilter(
        SafetyFilter(
            model,
            [(Barrier(1 - x - sp.sqrt(2) * y**2), CBF(alpha=1.0))],
            input_bounds=[(-9.0, 9.0)],
        )
    )
    rng = np.random.default_rng(0)
    assert assert_slopes(module, rng.normal(size=(30, 2)), 4.0 + rng.normal(size=(30, 1))) > 25


def test_a_minimum_has_the_gradients_of_its_pieces_and_a_maximum_is_refused():
    x, y, u, w = sp.symbols("x y u w", real=True)
    model = ControlAffineSDE((x, y), (u, w), [y, 0], [[1, 0], [0, 1]])
    minimum = SafetyFilter(model, 1 - x - sp.Abs(y), "cbf:alpha=2", input_bounds=[(-9, 9)] * 2)
    rng = np.random.default_rng(0)
    states, inputs = rng.normal(size=(30, 2)) / 2, rng.normal(size=(30, 2)) + 1
    assert assert_slopes(TorchFilter(minimum), states, inputs) > 25
    with pytest.raises(ConfigurationError, match="maximum"):
        TorchFilter(SafetyFilter(model, sp.Max(x, y), "cbf", input_bounds=[(-9, 9)] * 2))


def test_names_of_symbols_change_nothing():
    found = []
    for names in (("y", "z"), ("x0", "x1"), ("x1", "sin"), ("torch", "None")):
        a, b = (sp.Symbol(name, real=True) for name in names)
        both, u = a + b, sp.Symbol("u", real=True)
        model = ControlAffineSDE(
            (a, b),
            (u,),
            [(both**2 + 3 * sp.sin(both)) * sp.sin(both), both**2],
            [[1], [0]],
            [[0], [0]],
        )
        module = TorchFilter(
            SafetyFilter(
                model, [(Barrier(1 - a - b**2), CBF(alpha=1.0))], input_bounds=[(-9.0, 9.0)]
            )
        )
        states = torch.tensor([0.9, 0.4], dtype=torch.float64, requires_grad=True)
        module(states, torch.tensor([8.0], dtype=torch.float64)).sum().backward()
        assert states.grad is not None
        found.append(states.grad.tolist())
    # u = 1 - a - b^2 - (s^2 + 3 sin s) sin s - 2 b s^2 with s = a + b.
    s, b = 1.3, 0.4
    by_both = (
        -(2 * s + 3 * math.cos(s)) * math.sin(s)
        - (s**2 + 3 * math.sin(s)) * math.cos(s)
        - 4 * b * s
    )
    assert found == [pytest.approx([by_both - 1, by_both - 2 * b - 2 * s**2], rel=1e-12)] * 4


X, U, P = sp.symbols("x u p", real=True)


def line(drift=0, h=1 - X, low=-1.0, **more):
    return SafetyFilter(ControlAffineSDE((X,), (U,), [drift], [1], [0], **more), h, "cbf", (low, 1))


def of_problem(name, text, measurement=None, **more):
    problem = make_problem(f"safe_envs/{name}-v0", measurement=measurement)
    return SafetyFilter.for_problem(problem, text, **more)


@pytest.mark.parametrize(
    ("make", "fragment"),
    [
        (lambda: of_problem("CubicSDE", "srcbf"), "reciprocal"),
        (lambda: of_problem("CubicSDE", "scbf:sampling_margin=first-order"), "first order"),
        (lambda: of_problem("CubicSDE", "scbf", objective="clf"), "clf"),
        (lambda: line(sp.erfc(X)), "erfc"),
        (lambda: line(h=P - X, signals={P: 0}), "takes p"),
        (lambda: line(low=-math.inf), "finite"),
        (lambda: of_problem("Pendulum", "scbf", "default", estimator="ekf"), "estimator ekf"),
        (lambda: of_problem("Pendulum", "scbf:belief=0.1", "default"), "belief"),
        (guess, "PromiseFilter"),
    ],
)
def test_a_filter_without_gradient_is_refused(make, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        TorchFilter(make())


@pytest.mark.parametrize(("name", "text"), [("DubinsDisk", "backup"), ("Scalar", "promise:p=0.9")])
def test_a_filter_by_itself_has_no_gradient(name, text):
    with pytest.raises(ConfigurationError, match=text.split(":")[0]):
        TorchFilter.for_problem(make_problem(f"safe_envs/{name}-v0"), text)
