"""Bayesian identification of an unknown control-affine system from one-step data."""

from __future__ import annotations

import math
import time
import warnings

import numpy as np

from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.bayesian_fit import Prior, fit
from safe_envs.wrappers.learning.checks import (
    Progress,
    Purpose,
    random_stream,
    require_kind,
    require_problem,
)
from safe_envs.wrappers.learning.data.collection import collect
from safe_envs.wrappers.learning.data.measured import sensor_deviations
from safe_envs.wrappers.learning.data.steps import Step
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.drift_checks import region_warnings
from safe_envs.wrappers.learning.errors_in_variables import corrected_fit
from safe_envs.wrappers.learning.identifiability import IdentifiabilityWarning, misfits, weaknesses
from safe_envs.wrappers.learning.models.base import Record
from safe_envs.wrappers.learning.models.distributions import Gaussian, require_prior
from safe_envs.wrappers.learning.models.features import Features
from safe_envs.wrappers.learning.models.posterior import Posterior
from safe_envs.wrappers.learning.regression import Rows

_HIGHEST_DEGREE = 3
_MOST_WEIGHTS = 200
_HELD_OUT = 0.2
_FEWEST_HELD_OUT = 10
_COLLECTING = 0.8


def identify(  # noqa: PLR0913 - the friendly keyword form
    problem: SafetyProblem,
    *,
    starts: int = 1000,
    steps: int = 1,
    repetitions: int = 100,
    degree: int | None = None,
    prior: float = 10.0,
    diffusion_degree: int = 0,
    alpha: float = 1.0,
    beta: float = 1.0,
    errors_in_variables: bool = True,
    data: Transitions | None = None,
    seed: int = 0,
    step: Step | None = None,
    progress: Progress | None = None,
) -> Posterior:
    """Learn f, g and sigma of a problem's plant.

    (x' - x)/dt = f(x) + g(x) u + noise of the covariance sigma sigma'/dt is regressed on features
    of the state, and on these times each input. The noise follows from repetitions, or in a log
    from what the fit leaves.

    Args:
        problem: its sampling domain says where and under which inputs data are collected.
        starts: number of trajectories.
        steps: of each.
        repetitions: K of each step.
        degree: of the features; None for the highest up to 3 with at most 200 weights for each
            state and two rows for each.
        prior: variance of each weight before, where each state is scaled from its region to [-1,
            1], each input by the largest that was tried, and time is in s.
        diffusion_degree: of the features on which the variances of the noise are regressed; 0 for
            constant noise.
        alpha: shape of the inverse-gamma prior of a constant sigma.
        beta: its scale, in the units of sigma.
        errors_in_variables: whether to correct the bias that the errors of the problem's sensor
            make, if it has one; see `safe_envs.wrappers.learning.errors_in_variables`.
        data: to learn from, instead of collecting any.
        seed: of all randomness.
        step: how the system is stepped; None for the plant.
        progress: called with the part that is done.

    Returns:
        What was learned. Warns (`IdentifiabilityWarning`) of what the data do not tell.

    Raises:
        LearnedFileError: the data are of another problem.
        ConfigurationError: an argument is not allowed, or the data are too few to tell the noise.

    Source: thesis Sec. 6.2 and 6.3.1; 10 starts x 100 steps and the priors 10 I (cubic) and 1e4 I
        (ACC) were taken for what the thesis leaves open. It identifies f under u = 0 and g under
        u = .1; here both come from inputs of both signs.
    """
    began = time.perf_counter()
    require_problem(problem)
    require_prior(alpha, beta)
    if not 0 < prior < math.inf:
        raise ConfigurationError(
            f"prior = {shown(prior)}; the variance of the weights is positive and finite"
        )
    collected = data is None
    if data is None:
        collecting = None if progress is None else lambda part: progress(_COLLECTING * part)
        data = collect(
            problem, starts, repetitions, steps=steps, seed=seed, step=step, progress=collecting
        )
    require_kind("data", data, Transitions, "collect, Transitions.from_log or Transitions.load")
    data.require(problem)
    rows = Rows.of(data)
    chosen = _degree(problem, len(rows.x)) if degree is None else degree
    features = Features.of(problem, chosen)
    varying = (
        Features.of(problem, diffusion_degree, "diffusion_degree") if diffusion_degree else None
    )
    half = 0.5 * np.ptp(problem.sampling_domain.region, axis=1)
    largest = abs(rows.u).max(axis=0)
    scale = 1.0 / np.where(largest > 0, largest, 1.0)
    design, believed = rows.design(features, scale), Prior(prior * half**2, alpha, beta)
    deviations = sensor_deviations(problem)
    if errors_in_variables and deviations.any():
        if varying is not None:
            raise ConfigurationError(
                f"diffusion_degree = {diffusion_degree}: noise that varies is not told from that of"
                " the sensor; leave it out, or give errors_in_variables=False"
            )
        # What was left out is measured with errors too, and says little.
        errors = {}
        found = corrected_fit(rows, features, scale, deviations, believed)
    else:
        errors = _held_out(data, features, scale, varying, believed)
        found = fit(rows, design, varying, believed)
    names = [u.name for u in problem.plant.inputs]
    warned = (
        *weaknesses(
            features,
            names,
            rows.x,
            rows.u,
            design,
            Gaussian(
                found.learned.mean / half[:, None],
                found.learned.covariance / (half**2)[:, None, None],
            ),
            prior,
        ),
        *misfits(features, found.misfit, found.variation),
        *region_warnings(problem, data),
    )
    for text in warned:
        warnings.warn(text, IdentifiabilityWarning, stacklevel=2)
    settings = {
        **({"starts": starts, "steps": steps} if collected else {"points": data.points}),
        "repetitions": data.repetitions,
        "degree": chosen,
        "diffusion_degree": diffusion_degree,
        "prior": prior,
        "alpha": alpha,
        "beta": beta,
        **({"errors_in_variables": errors_in_variables} if deviations.any() else {}),
        # Of data from elsewhere it is not known how finely a step was integrated: see
        # `safe_envs.wrappers.verification.step_bias`.
        **({"substeps": problem.substeps} if collected and step is None else {}),
    }
    if progress is not None:
        progress(1.0)
    record = Record(
        data.count, data.observed, time.perf_counter() - began, data.seed, errors, settings, warned
    )
    weights = found.learned.mean, found.learned.covariance
    rest = found.diffusion, float(data.dt.mean()), found.misfit, found.variation
    inputs = problem.plant.inputs
    return Posterior(data.signature, record, features, inputs, scale, *weights, *rest)


def _degree(problem: SafetyProblem, rows: int) -> int:
    """Return the highest degree that the number of weights allows."""
    lowest = Features.of(problem, 1)
    coordinates = lowest.count - 1
    parts = 1 + len(problem.inputs)
    allowed = [
        d
        for d in range(2, _HIGHEST_DEGREE + 1)
        if math.comb(coordinates + d, d) * parts <= min(_MOST_WEIGHTS, rows / 2)
    ]
    return max(allowed, default=1)


def _held_out(
    data: Transitions, features: Features, scale: np.ndarray, varying: Features | None, prior: Prior
) -> dict[str, float]:
    """Return root-mean-square errors of the rates at start states left out, for each state.

    They are in its units per s, with the part that the noise of the data explains; and in standard
    deviations of the prediction, which are 1 where the posterior is right. Empty where the data are
    too few to leave any out.
    """
    if len(np.unique(data.x, axis=0)) < _FEWEST_HELD_OUT:
        return {}
    trained, held = (
        Rows.of(part)
        for part in data.split(_HELD_OUT, random_stream(data.seed or 0, Purpose.HELD_OUT))
    )
    found = fit(trained, trained.design(features, scale), varying, prior)
    design = held.design(features, scale)
    error = held.rate - design @ found.learned.mean.T
    noise = found.diffusion.variances(held.x) / (held.dt * held.count)[:, None]
    doubt = np.einsum("bd,nde,be->bn", design, found.learned.covariance, design, optimize=True)
    sizes = {"error": error**2, "noise": noise, "standardised": error**2 / (noise + doubt)}
    return {
        f"{state} {name}": float(np.sqrt(values[:, i].mean()))
        for i, state in enumerate(features.states)
        for name, values in sizes.items()
    }
