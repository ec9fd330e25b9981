"""The check of a system: what an author may have broken, and what is derived from the symbols."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import generator, ito_correction, lie_derivative_f, lie_derivative_g
from safe_envs.dynamics.min_max import pieces
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.env import SafeEnv
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import SafeEnvsError
from safe_envs.problem.factory import load_system
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.validation import degree_of, require_sound
from safe_envs.registry import make_problem
from safe_envs.systems import ENV_IDS

_NUM_ENVS = 3
_STATES = 8
_FIRST, _SECOND = 1e-6, 1e-3
"""Steps of the first and of the second differences, relative to the state."""
_EPSILON = float(np.finfo(float).eps)

System = SafetyProblem | Callable[[], SafetyProblem] | str


def check_system(system: System, *, steps: int = 50, seed: int = 0) -> None:
    """Check a system as `check_env` of Gymnasium checks an env.

    The properties are: a sound "definition", the same problem each time ("reproducible"), options
    and pickles that give it back ("round trip"), a "reset" that repeats and starts in the safe set,
    observations and inputs within their "bounds", a "batch" that equals the scalar env, and
    "derivatives" of the barriers that agree with finite differences.

    Args:
        system: a problem, a function that returns one, the id of an env of this project,
            FILE.py:NAME, MODULE:NAME or the name of an entry point.
        steps: control periods to simulate.
        seed: of starts, actions and noise.

    Raises:
        AssertionError: A property does not hold; the message begins with its name.
    """
    problem = _checked("definition", lambda: _built(system))
    _checked("definition", lambda: require_sound(problem))
    _require("reproducible", _built(system) == problem, "built twice, the problems differ")
    _check_round_trip(problem)
    states = _checked("batch", lambda: _check_simulation(problem, steps, seed))
    for believed, dynamics in (("plant", problem.plant), ("model", problem.model)):
        for barrier in problem.barriers:
            degree = degree_of(dynamics, barrier.expression)
            for phi in pieces(barrier.expression):
                for level in range(degree):
                    title = f"{barrier.name} (level {level}, {believed})"
                    _check_derivatives(title, phi, dynamics, states)
                    phi = generator(dynamics, phi)


def _built(system: System) -> SafetyProblem:
    if isinstance(system, SafetyProblem):
        return system
    if isinstance(system, str) and {system, f"safe_envs/{system}"} & {*ENV_IDS}:
        return make_problem(system)
    found = (load_system(system) if isinstance(system, str) else system)()
    _require("definition", isinstance(found, SafetyProblem), f"{system} gives {found!r}")
    return found


def _require(name: str, holds: Any, message: str) -> None:
    if not holds:
        raise AssertionError(f"{name}: {message}")


def _checked(name: str, action: Callable[[], Any]) -> Any:
    try:
        return action()
    except SafeEnvsError as error:
        raise AssertionError(f"{name}: {error}") from error


def _check_round_trip(problem: SafetyProblem) -> None:
    levels = {p.name: value for p, value in problem.plant.parameters.items()}
    _require(
        "round trip",
        set(problem.noise) <= set(levels),
        f"noise names {problem.noise}, which are not all parameters of the plant: {list(levels)}",
    )
    same = {
        "plant": levels,
        "model": {p.name: value for p, value in problem.model.parameters.items()},
        "dt": problem.dt,
        "substeps": problem.substeps,
        "horizon": problem.horizon,
        "input_bounds": problem.input_bounds,
        "start": problem.start,
        **({"noise": [levels[name] for name in problem.noise]} if problem.noise else {}),
    }
    again = _checked("round trip", lambda: problem.configured(**same))
    _require("round trip", again == problem, f"configured with its own values it is {again}")
    try:
        copy = pickle.loads(pickle.dumps(problem))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise AssertionError(f"round trip: the problem cannot be pickled: {error}") from error
    _require("round trip", copy == problem, "unpickled, the problem is another one")


def _check_simulation(problem: SafetyProblem, steps: int, seed: int) -> list[Sequence[float]]:
    """Check resets, bounds and the batch; return some of the states that were visited."""
    envs, batch = [SafeEnv(problem) for _ in range(_NUM_ENVS)], SafeVectorEnv(problem, _NUM_ENVS)
    first = [env.reset(seed=seed + i) for i, env in enumerate(envs)]
    for i, (observation, info) in enumerate(first):
        _require("reset", info["h_min"] > 0.0, f"the start {envs[i].components} is not safe")
        again, _ = envs[i].reset(seed=seed + i)
        _require("reset", np.array_equal(again, observation), f"seed {seed + i} gives two starts")
    _require_alike(dict(enumerate(first)), batch.reset(seed=seed), "reset")
    visited, running = [env.components for env in envs], list(range(_NUM_ENVS))
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, _NUM_ENVS, problem.plant.m))
    for k, action in enumerate(actions):
        found = {i: envs[i].step(action[i]) for i in running}
        _require_alike(found, batch.step(action), f"step {k}")
        for i in running:
            _require_within(problem, envs[i], found[i])
        running = [i for i in running if not (found[i][2] or found[i][3])]
        visited += [envs[i].components for i in running]
        if not running:
            break
    chosen = np.random.default_rng(seed).permutation(len(visited))[:_STATES]
    return [visited[i] for i in chosen]


def _require_within(problem: SafetyProblem, env: SafeEnv, found: tuple[Any, ...]) -> None:
    observation, _, terminated, _, _ = found
    _require(
        "bounds",
        terminated or env.observation_space.contains(observation),
        f"the observation {observation} at {env.components} is outside {env.observation_space}",
    )
    for u, (low, high) in zip(env.executed, problem.input_bounds, strict=True):
        _require("bounds", low <= u <= high, f"the input {u} is outside [{low}, {high}]")


def _require_alike(
    alone: Mapping[int, tuple[Any, ...]], together: tuple[Any, ...], where: str
) -> None:
    """Compare what scalar envs and the batch return at the same time, up to rounding."""
    for i, (*parts, info) in alone.items():
        pairs = [
            *((one, part[i]) for one, part in zip(parts, together[:-1], strict=True)),
            *((one, together[-1][key][i]) for key, one in info.items()),
        ]
        for one, other in pairs:
            _require(
                "batch",
                np.allclose(one, other, rtol=1e-5, atol=1e-8),
                f"at {where} env {i} of the batch has {other}, and the scalar env {one}: rounding"
                " grows too fast, or a formula has no value",
            )


def _check_derivatives(title: str, phi: sp.Expr, system: ControlAffineSDE, states: Any) -> None:
    """Compare Lie derivatives and the Ito correction of a function with finite differences."""

    def compiled(expressions: Any) -> Callable[..., Sequence[float]]:
        return compile_function(
            system.states, [system.numeric(sp.sympify(e)) for e in expressions], "floats"
        )

    lie = (lie_derivative_f(system, phi), *lie_derivative_g(system, phi))
    value, exact = compiled([phi]), compiled((*lie, ito_correction(system, phi)))
    along = compiled([*system.drift, *system.input_matrix.T, *system.diffusion.T])
    for x in states:
        directions = np.reshape(along(*x), (-1, system.n))
        found = [_difference(value, x, d, 1) for d in directions[: 1 + system.m]]
        noise = [_difference(value, x, d, 2) for d in directions[1 + system.m :]]
        found.append((0.5 * sum(v for v, _ in noise), sum(rounding for _, rounding in noise)))
        names = ("the drift", *map(str, system.inputs), "the noise")
        for name, symbolic, (numeric, rounding) in zip(names, exact(*x), found, strict=True):
            _require(
                "derivatives",
                abs(symbolic - numeric) <= 1e-4 * (abs(symbolic) + abs(numeric)) + rounding,
                f"that of {title} along {name} is {symbolic} at {x}, and {numeric} by finite"
                " differences: it has a jump or a kink there, or varies too fast for its numbers",
            )


def _difference(
    value: Callable[..., Sequence[float]], x: Sequence[float], direction: np.ndarray, order: int
) -> tuple[float, float]:
    """Return a derivative along a direction by central differences, and a bound of its rounding."""
    size = float(np.max(np.abs(direction) / np.maximum(1.0, np.abs(x))))
    if not size:
        return 0.0, 0.0
    step = (_FIRST if order == 1 else _SECOND) / size
    (ahead,), (here,), (behind,) = (value(*np.add(x, s * direction)) for s in (step, 0.0, -step))
    found = (
        (ahead - behind) / (2.0 * step) if order == 1 else (ahead - 2.0 * here + behind) / step**2
    )
    return found, 100.0 * _EPSILON * max(abs(ahead), abs(here), abs(behind), 1.0) / step**order
