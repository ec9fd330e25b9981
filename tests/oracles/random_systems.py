"""Random systems, and the rates that their filters reach against inputs that try to leave."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import sympy as sp
from scipy import stats

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.agents import evaluate
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.starts import Start
from safe_envs.proofs.posterior import guarantee_of
from safe_envs.wrappers import parse_conditions

_DT, _HORIZON = 2e-3, 1.0
_CANDIDATES, _CORNERS = 512, 4


class Rate(NamedTuple):
    """Episodes under one policy from one start, with the bound.

    Attributes:
        policy: who acts.
        start: state (n,).
        bound: of the probability of staying safe.
        safe: number of episodes that stayed safe.
        episodes: number of all.
    """

    policy: str
    start: tuple[float, ...]
    bound: float
    safe: int
    episodes: int

    def upper(self, error: float) -> float:
        """Return the upper end of the Clopper-Pearson interval that errs with a probability."""
        if self.safe == self.episodes:
            return 1.0
        return float(stats.beta.ppf(1.0 - error, self.safe + 1, self.episodes - self.safe))


def random_system(seed: int) -> tuple[SafetyProblem, str]:
    """Draw a system of 1 to 4 states, its barriers and its filter.

    Args:
        seed: of the draw.
    """
    rng = np.random.default_rng(seed)
    second = rng.random() < 0.35
    return _of_degree_two(rng) if second else _of_degree_one(rng)


def _number(rng: np.random.Generator, low: float, high: float) -> float:
    return round(float(rng.uniform(low, high)), 3)


def _wave(rng: np.random.Generator, states: Sequence[Any], size: float) -> Any:
    """Draw a polynomial and waves of the states."""
    found: Any = _number(rng, -size, size) / 2
    for _ in range(rng.integers(1, 4)):
        s, t = (states[i] for i in rng.integers(0, len(states), 2))
        part = [s, s * t, s**3, sp.sin(2 * s), sp.cos(s - t), sp.exp(-(s**2))][rng.integers(6)]
        found += _number(rng, -size, size) * part
    return found


def _axes(rng: np.random.Generator, n: int) -> list[list[float]]:
    turned = np.linalg.qr(rng.standard_normal((n, n)))[0]
    return (turned if rng.random() < 0.5 else np.eye(n)).round(6).tolist()


def _noise(rng: np.random.Generator, states: Sequence[Any], noisy: bool) -> list[Any]:
    if not noisy:
        return [0] * len(states)
    kinds = rng.integers(0, 3, len(states))
    largest = float(rng.choice([0.2, 0.5, 1.5]))
    sizes = [_number(rng, 0.2 * largest, largest) for _ in states]
    return [
        [size, size * s, size * sp.cos(2 * s)][kind]
        for size, s, kind in zip(sizes, states, kinds, strict=True)
    ]


def _of_degree_one(rng: np.random.Generator) -> tuple[SafetyProblem, str]:
    n = int(rng.integers(1, 5))
    m = int(rng.integers(1, n + 1)) if rng.random() < 0.3 else n
    xs, us = sp.symbols(f"x_1:{n + 1}", real=True), sp.symbols(f"u_1:{m + 1}", real=True)
    axes, noisy = _axes(rng, n), rng.random() < 0.8
    rows = [_wave(rng, xs, 0.6) + sum(axes[i][j] * us[j] for j in range(m)) for i in range(n)]
    system = ControlAffineSDE.from_rate(
        xs, us, rows, diffusion=[[e] for e in _noise(rng, xs, noisy)]
    )
    turned: Any = [sum(a * s for a, s in zip(row, xs, strict=True)) for row in _axes(rng, n)]
    weights = [_number(rng, 0.6, 1.6) for _ in xs]
    ellipse = 1 - sum(w * t**2 for w, t in zip(weights, turned, strict=True))
    wave = sp.cos(xs[0]) - 0.2 - sum(w * t**2 for w, t in zip(weights, turned, strict=True)) / 4
    ramp = 1 - turned[0] - 0.2 * turned[-1] ** 2
    barriers: list[Any] = [[ellipse], [wave], [ramp], [ramp], [1 - xs[0], 1 + xs[-1]]][
        rng.integers(5)
    ]
    if not noisy:
        text = f"cbf:alpha={_number(rng, 0.5, 4)}"
    else:
        text = "scbf" if rng.random() < 0.3 else f"szcbf:alpha={_number(rng, 0.1, 2)}"
    return _problem(rng, system, barriers, dict.fromkeys(xs, (-1.5, 1.5))), text


def _of_degree_two(rng: np.random.Generator) -> tuple[SafetyProblem, str]:
    pairs = int(rng.integers(1, 3))
    ps, vs = sp.symbols(f"p_1:{pairs + 1}", real=True), sp.symbols(f"v_1:{pairs + 1}", real=True)
    us = sp.symbols(f"u_1:{pairs + 1}", real=True)
    noisy = rng.random() < 0.7
    xs = (*ps, *vs)
    rows = [*vs, *(_wave(rng, xs, 0.5) + u for u in us)]
    noise = [[each] for each in (*[0] * pairs, *_noise(rng, vs, noisy))]
    system = ControlAffineSDE.from_rate(xs, us, rows, diffusion=noise)
    round_: Any = 1 - sum(p**2 for p in ps)
    kinds = [[round_], [1 - ps[0]], [1 - ps[0] + 0.2 * ps[-1] ** 2], [1 - ps[0], 1 + ps[-1]]]
    barriers = kinds[rng.integers(4)]
    a, b = _number(rng, 0.1, 0.6), _number(rng, 0.1, 0.6)
    if not noisy:
        a, b = 2 * a, 5 * b
    text = f"szcbf:alpha={a},{b}" if noisy else f"hocbf:alpha={a},{b}"
    ranges = {**dict.fromkeys(ps, (-1.5, 1.5)), **dict.fromkeys(vs, (-2.0, 2.0))}
    return _problem(rng, system, barriers, ranges), text


def _problem(
    rng: np.random.Generator, system: ControlAffineSDE, barriers: Any, ranges: Any
) -> SafetyProblem:
    high = _number(rng, 4, 16)
    return define_problem(
        system,
        barriers,
        input_bounds=[(-high, high)] * system.m,
        workspace=ranges,
        start=(0.0,) * system.n,
        dt=_DT,
        horizon=_HORIZON,
        nominal=[0] * system.m,
    )


def proved_starts(
    problem: SafetyProblem, text: str, parts: Sequence[float], seed: int = 0
) -> list[tuple[np.ndarray, float]]:
    """Return starts with a bound above 0, and the bounds; none where it is not proved.

    Args:
        problem: with its filter.
        text: of the filter.
        parts: for each start, the part of the candidates whose bound is below its own.
        seed: of the candidates.
    """
    guarantee: Any = guarantee_of(problem, parse_conditions(text, problem))
    if guarantee.word != "proved":
        return []
    ends = np.array([(v.low, v.high) for v in problem.states], dtype=float)
    given = problem.starts[problem.start].proposals(1)
    near = np.array(given, dtype=float).reshape(1, -1)
    low = np.where(np.isfinite(ends[:, 0]), ends[:, 0], near[0] - 3.0)
    high = np.where(np.isfinite(ends[:, 1]), ends[:, 1], near[0] + 3.0)
    drawn = np.random.default_rng(seed).uniform(low, high, (_CANDIDATES, len(low)))
    candidates = np.concatenate([near, 0.4 * drawn + 0.6 * near, drawn])
    bounds = guarantee.at(candidates, problem.horizon)
    order = np.argsort(bounds)[(bounds <= 0.0).sum() :]
    if not len(order):
        return []
    chosen = [order[round(part * (len(order) - 1))] for part in parts]
    return [(candidates[i], float(bounds[i])) for i in dict.fromkeys(chosen)]


def policies(problem: SafetyProblem) -> Iterator[tuple[str, Any]]:
    """Yield policies with their names: some that do not care, and some that are hostile."""
    yield "nominal", "nominal"
    yield "random", "random"
    system, m = problem.plant, problem.plant.m
    corners = list(itertools.product((-1.0, 1.0), repeat=m))[:_CORNERS]
    for corner in corners:
        yield f"constant {corner}", _constant(np.array(corner))
    for i, barrier in enumerate(problem.barriers):
        # Towards the edge: along inputs that lower h at once, or its derivative along the drift.
        lowered: Any = system.exact(barrier.expression)
        row = _along_inputs(system, lowered)
        if not any(row):
            drift = map(system.exact, system.drift)
            terms: Any = zip(system.states, drift, strict=True)
            row = _along_inputs(system, sum(lowered.diff(s) * f for s, f in terms))
        yield f"against h_{i + 1}", _against(sp.lambdify([system.states], row, "numpy"))


def _along_inputs(system: ControlAffineSDE, expression: Any) -> list[Any]:
    """Return the derivative of an expression along each input."""
    columns: Any = system.input_matrix.T.tolist()
    slopes = [expression.diff(s) for s in system.states]
    return [
        sum(p * system.exact(g) for p, g in zip(slopes, column, strict=True)) for column in columns
    ]


def _constant(action: np.ndarray) -> Any:
    def constant(rows: np.ndarray) -> np.ndarray:
        return np.tile(action, (len(rows), 1))

    return constant


def _against(slopes: Any) -> Any:
    def against(rows: np.ndarray) -> np.ndarray:
        x = np.asarray(rows, dtype=float)
        with np.errstate(all="ignore"):
            found = [np.broadcast_to(s, len(x)) for s in slopes(x.T)]
        return -np.sign(np.nan_to_num(np.stack(found, axis=1)))

    return against


def rates(
    problem: SafetyProblem,
    text: str,
    starts: Sequence[tuple[np.ndarray, float]],
    episodes: int,
    only: str = "",
) -> list[Rate]:
    """Simulate each start under each policy.

    Args:
        problem: with its filter.
        text: of the filter.
        starts: states and their bounds.
        episodes: number for each.
        only: beginning of the names of policies that act; all by default.
    """
    found = []
    for state, bound in starts:
        start = tuple(state.tolist())
        begun = replace(problem, starts={problem.start: Start.at(start)})
        for label, policy in policies(problem):
            if label.startswith(only):
                (row,) = evaluate(
                    begun,
                    policy,
                    [text],
                    episodes=episodes,
                    bounds=False,
                    best=False,
                    keep_episodes=False,
                ).rows
                found.append(Rate(label, start, bound, row.safe, episodes))
    return found


def contradictions(
    problem: SafetyProblem, text: str, found: Sequence[Rate], error: float
) -> list[str]:
    """Say which bounds are above the rates, with the rates at half and a quarter of the step.

    A rate that rises towards the bound with shorter steps tells of an input that is held, and one
    that stays of a false proof.

    Args:
        problem: with its filter.
        text: of the filter.
        found: rates to be compared.
        error: probability that one true bound is contradicted by chance.
    """
    said = []
    for rate in found:
        if rate.bound <= rate.upper(error):
            continue
        finer = []
        for parts in (2, 4):
            shorter = replace(problem, dt=problem.dt / parts)
            starts = [(np.array(rate.start), rate.bound)]
            finer += rates(shorter, text, starts, rate.episodes, rate.policy)
        shares = [f"{r.safe}/{r.episodes}" for r in (rate, *finer)]
        said.append(
            f"{problem.plant.drift.tolist()}, {text}, {rate.policy} from {rate.start}: proved"
            f" {rate.bound:.4g}, safe {shares[0]}; with shorter steps {', '.join(shares[1:])}"
        )
    return said
