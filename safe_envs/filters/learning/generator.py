"""Learning the generator of a barrier under unknown noise: DDSCBF, or by the covariance."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, Literal, get_args

import numpy as np

from safe_envs.dynamics.codegen import Components, compile_function, stacked
from safe_envs.dynamics.lie import derivatives, gradient, lie_derivative_f, relative_degree
from safe_envs.errors import ConfigurationError, shown
from safe_envs.filters.learning.checks import (
    Progress,
    Purpose,
    random_stream,
    require_kind,
    require_problem,
)
from safe_envs.filters.learning.collection import Step, collect
from safe_envs.filters.learning.data import Signature, Transitions
from safe_envs.filters.learning.drift_checks import (
    Estimator,
    by_parts,
    drift_warnings,
    in_bulk,
    ito_part,
    mean_rates,
    rates,
    region_warnings,
    require_estimator,
    rounding,
    slack,
)
from safe_envs.filters.learning.models.base import Record
from safe_envs.filters.learning.models.features import Features
from safe_envs.filters.learning.models.generator import (
    ACTIVATION,
    Entry,
    GeneratorModel,
    LearnedDiffusion,
    LearnedGenerator,
    order_label,
)
from safe_envs.filters.learning.residual import AdamSettings, train
from safe_envs.problem.problem import Barrier, SafetyProblem

_DEGREES = (0, 1, 2)
_HELD_OUT = 0.2
_FEWEST_STARTS = 5

_EXACT = 1e-12


def learn_diffusion(
    problem: SafetyProblem, data: Transitions, rate: np.ndarray, allowed: np.ndarray | float = 0.0
) -> tuple[LearnedDiffusion, dict[str, float]]:
    """Regress the covariances by least squares, with the degree of least BIC.

    Args:
        problem: over whose region the features are scaled.
        data: transitions under any inputs; one from each point is enough where there are many
            points.
        rate: f(x) + g(x) u at each point, or its mean over the steps, shape (P, n); see
            `safe_envs.filters.learning.drift_checks`.
        allowed: residual of each state, shape (n,), that is no noise where data do not repeat;
            see `slack` there.

    Returns:
        What was learned from all points; and by name, for each entry that is not zero, the root
        mean square error of a regression on 80 % of the start states at the others, empty where
        there are less than five. It contains the error of the covariances there, sqrt(2/(K -
        1)) of a diagonal entry.

    Source: thesis Sec. 5.3 learns from the same data a term of a single barrier's generator.
    """
    found = covariances(data, rate)
    small = rounding(data, rate) + (allowed if data.repetitions == 1 else 0.0)
    noisy = found.diagonal(axis1=1, axis2=2).max(axis=0) > small**2 / data.dt.min()
    pairs = [
        (i, j) for i in range(len(noisy)) for j in range(i, len(noisy)) if noisy[i] and noisy[j]
    ]
    designs = _designs(problem, data.x)
    fits = {(i, j): _fit(designs, found[:, i, j], may_vanish=i != j) for i, j in pairs}
    entries = tuple(Entry(i, j, *fit) for (i, j), fit in fits.items() if fit is not None)
    return LearnedDiffusion(problem.plant.states, entries), _held_out_errors(
        problem, data, found, entries
    )


def covariances(data: Transitions, rate: np.ndarray) -> np.ndarray:
    """Estimates of sigma sigma' at each point, free of bias for Euler-Maruyama steps.

    With repetitions they are the covariances of the sample, over dt: whatever the drift is, and
    however a step without noise was integrated, is not taken for noise. A single successor leaves r
    r'/dt with the residual r = x' - x - (f + g u) dt, to which an error e of the known drift adds e
    e' dt.

    Args:
        data: transitions under any inputs.
        rate: f(x) + g(x) u at each point, or its mean over the steps, shape (P, n).

    Returns:
        Shape (P, n, n), in units of the states' products per s.
    """
    expected = (data.x + rate * data.dt[:, None]).T
    found = np.empty((data.points, len(expected), len(expected)))
    more = data.repetitions - 1
    for part, successors in by_parts(data):
        means = [after.mean(axis=1) for after in successors] if more else expected[:, part]
        residuals = [after - mean[:, None] for after, mean in zip(successors, means, strict=True)]
        scale = data.dt[part] * max(more, 1)
        for i, first in enumerate(residuals):
            for j, second in enumerate(residuals[: i + 1]):
                found[part, i, j] = found[part, j, i] = np.einsum("pk,pk->p", first, second) / scale
    return found


def _designs(problem: SafetyProblem, x: np.ndarray) -> list[tuple[Features, np.ndarray]]:
    """Return the features (P, M) of each degree at states (P, n), while M is at most P/2."""
    candidates = [
        Features.of(problem, degree) for degree in _DEGREES if Features.allowed(problem, degree)
    ]
    return [(f, f.matrix(x)) for f in candidates if f.degree == 0 or 2 * f.count <= len(x)]


def _fit(
    designs: Sequence[tuple[Features, np.ndarray]], values: np.ndarray, may_vanish: bool
) -> tuple[Features, np.ndarray] | None:
    """Return features and weights of the regression of values (P,) with least BIC; None for 0."""
    # A fit without any residual would win over all others, by an infinite margin.
    floor = len(values) * (_EXACT * np.abs(values).max()) ** 2

    def criterion(residuals: np.ndarray, count: int) -> float:
        return len(values) * np.log(max(residuals @ residuals, floor)) + count * np.log(len(values))

    best, least = None, criterion(values, 0) if may_vanish else np.inf
    for features, matrix in designs:
        weights = np.linalg.lstsq(matrix, values)[0]
        score = criterion(values - matrix @ weights, features.count)
        if score < least:
            best, least = (features, weights), score
    return best


def _held_out_errors(
    problem: SafetyProblem, data: Transitions, found: np.ndarray, entries: Sequence[Entry]
) -> dict[str, float]:
    """See `learn_diffusion`."""
    if len(np.unique(data.x, axis=0)) < _FEWEST_STARTS:
        return {}
    held = data.held_out(_HELD_OUT, random_stream(data.seed or 0, Purpose.HELD_OUT))
    trained = ~held
    designs, errors = _designs(problem, data.x[trained]), {}
    for entry in entries:
        fit = _fit(
            designs, found[trained, entry.row, entry.column], may_vanish=entry.row != entry.column
        )
        predicted = 0.0 if fit is None else fit[0].matrix(data.x[held]) @ fit[1]
        names = ", ".join(problem.states[i].symbol.name for i in (entry.row, entry.column))
        errors[f"C({names})"] = float(
            np.sqrt(np.mean((predicted - found[held, entry.row, entry.column]) ** 2))
        )
    return errors


Way = Literal["network", "direct"]
"""How a generator is learned: see `learn_generator`."""

_TRAINING = AdamSettings((100, 30), ACTIVATION, batch=32)


def learn_generator(  # noqa: PLR0913 - the friendly keyword form
    problem: SafetyProblem,
    *,
    points: int = 200,
    repetitions: int = 50_000,
    estimator: Estimator = "martingale",
    way: Way | None = None,
    data: Transitions | None = None,
    seed: int = 0,
    step: Step | None = None,
    progress: Progress | None = None,
) -> GeneratorModel:
    """Learn what noise adds to the generators of a problem's barriers, where f and g are known.

    The way "network" is the thesis': M_1 is fitted to estimates of 1/2 tr(sigma sigma' h_xx). For r
    >= 2 it goes on with A b_(j-1) of b_(j-1) = L_f^(j-1) h + M_(j-1), so that a network is
    differentiated twice by finite noise: M_j is fitted to L_f M_(j-1) + the estimate for b_(j-1).
    The way "direct" learns the covariance of the noise and differentiates symbols.

    Args:
        problem: whose plant is sampled; of its model, the noise is ignored.
        points: N, number of states, drawn from where the problem is explored.
        repetitions: n, transitions from each, under the input nearest to 0.
        estimator: see `safe_envs.filters.learning.drift_checks.ito_part`; for the way "network".
        way: None for "network" where all barriers have relative degree 1, and "direct" elsewhere
            and for data without repetitions.
        data: to learn from instead, under any inputs; `points`, `repetitions` and `step` are
            ignored then.
        seed: of all randomness.
        step: how the system is stepped; None for the plant's.
        progress: called with the part that is done.

    Returns:
        The generators of all barriers, or the covariance from which they follow.

    Raises:
        ConfigurationError: an argument is not allowed, or the data are of another system.
        InvalidInputError: there are too few points for a network.
        RelativeDegreeError: a barrier has none.

    Source: thesis Algorithm 2, Sec. 5.3. Its estimator is "printed", 200 points, 50000 transitions
        from each.
    """
    require_problem(problem)
    require_estimator(estimator)
    if way not in (None, *get_args(Way)):
        raise ConfigurationError(f"way = {shown(way)}; allowed: {', '.join(get_args(Way))}")
    begin, tell = time.perf_counter(), progress or (lambda _: None)
    degrees = [relative_degree(problem.model, b.expression) for b in problem.barriers]
    if data is None:
        at_rest = [min(max(0.0, low), high) for low, high in problem.input_bounds]
        data = collect(
            problem,
            points,
            repetitions,
            [at_rest],
            seed=seed,
            step=step,
            progress=lambda part: tell(0.5 * part),
        )
    require_kind("data", data, Transitions, "collect, Transitions.from_log or Transitions.load")
    data.require(problem)
    way = way or ("network" if max(degrees) == 1 and data.repetitions > 1 else "direct")
    settings: dict[str, Any] = {"way": way, "points": data.points, "repetitions": data.repetitions}
    rate = rates(problem.model, data)
    mean = mean_rates(problem.model, data, rate)
    warnings = (
        *drift_warnings(data, rate, mean, [s.name for s in problem.model.states]),
        *region_warnings(problem, data),
    )
    errors, generators, diffusion = {}, [], None
    if way == "direct":
        diffusion, errors = learn_diffusion(problem, data, mean, slack(data, rate, mean))
        warnings += () if diffusion.entries else ("the data show no noise, and none was learned",)
    else:
        settings |= {"estimator": estimator, "training_seed": seed, **asdict(_TRAINING)}
        settings["hidden"] = list(_TRAINING.hidden)
        done, every = 0, sum(degrees)
        # The printed estimator has the bias that it was printed with.
        taken = rate if estimator == "printed" else mean
        for barrier, degree in zip(problem.barriers, degrees, strict=True):
            found = LearnedGenerator(problem.plant.states, problem.sampling_domain.coordinates, ())
            for _ in range(degree):
                how = {
                    "seed": seed,
                    "progress": lambda part, k=done: tell(0.5 + 0.5 * (k + part) / every),
                }
                found, new = _next_order(problem, barrier, found, data, taken, estimator, **how)
                errors |= new
                done += 1
            generators.append(found)
    tell(1.0)
    record = Record(
        data.count,
        data.observed,
        time.perf_counter() - begin,
        data.seed,
        errors,
        settings,
        warnings,
    )
    signature = replace(
        Signature.of(problem), plant=data.signature.plant, **({"barriers": ()} if diffusion else {})
    )
    return GeneratorModel(signature, record, tuple(generators), diffusion)


def _next_order(
    problem: SafetyProblem,
    barrier: Barrier,
    known: LearnedGenerator,
    data: Transitions,
    rate: np.ndarray,
    estimator: Estimator,
    **how: Any,
) -> tuple[LearnedGenerator, dict[str, float]]:
    """Add M_j to M_1..M_(j-1); return held-out errors and standard errors of labels too."""
    model, below, n = problem.model, known.degree, problem.plant.n
    base = model.numeric(derivatives(model, barrier.expression, below, lie_derivative_f)[-1])
    read_base = compile_function(model.states, (base,), "arrays")
    read = compile_function(
        model.states, (*gradient(model, base), *model.numeric(model.drift)), "arrays"
    )

    def value(x: Components) -> Any:
        return read_base(*x)[0] + (
            in_bulk(known.networks[-1], known.coordinates_at(x)) if below else 0.0
        )

    def slopes(x: Components) -> Components:
        own = read(*x)[:n]
        return (
            tuple(a + b for a, b in zip(own, known.slopes(below, x), strict=True)) if below else own
        )

    x = tuple(np.ascontiguousarray(data.x.T))
    estimate = ito_part(data, rate, value, slopes, estimator)
    labels = estimate.values
    if below:
        labels += sum(
            slope * f for slope, f in zip(known.slopes(below, x), read(*x)[n:], strict=True)
        )
    trained = train(
        stacked(known.coordinates_at(x), data.points), labels[:, None], _TRAINING, **how
    )
    label = order_label(below + 1, barrier)
    errors = {label: float(np.median(trained.heldout))}
    if estimate.deviations is not None:
        errors[f"{label}, standard error of labels"] = float(
            np.sqrt(np.mean(estimate.deviations**2))
        )
    return replace(known, networks=(*known.networks, trained.network)), errors
