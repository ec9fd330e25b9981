"""Learning the generator of a barrier under unknown noise: DDSCBF, or by the covariance."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from typing import Any, Literal, get_args

import numpy as np

from safe_envs.dynamics.codegen import Components, compile_function, stacked
from safe_envs.dynamics.lie import derivatives, gradient, lie_derivative_f, relative_degree
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.barrier import Barrier
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.checks import Progress, require_kind, require_problem
from safe_envs.wrappers.learning.data.collection import collect
from safe_envs.wrappers.learning.data.signature import Signature
from safe_envs.wrappers.learning.data.steps import Step
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.diffusion import learn_diffusion
from safe_envs.wrappers.learning.drift_checks import drift_warnings, region_warnings, slack
from safe_envs.wrappers.learning.estimators import (
    Estimator,
    in_bulk,
    ito_part,
    mean_rates,
    rates,
    require_estimator,
)
from safe_envs.wrappers.learning.fit import AdamSettings, train
from safe_envs.wrappers.learning.models.base import Record
from safe_envs.wrappers.learning.models.generator import (
    ACTIVATION,
    GeneratorModel,
    LearnedGenerator,
    order_label,
)

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
        estimator: see `safe_envs.wrappers.learning.estimators.ito_part`; for the way "network".
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
        at_rest = [min(max(0.0, low), high) for low, high in problem.box]
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
