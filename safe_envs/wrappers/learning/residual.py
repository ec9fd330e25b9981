"""Learning what a model gets wrong in the derivatives of a barrier, from short paths of the plant.

A network says something everywhere, but it has seen states of the explored region only. Outside it
extrapolates, and the errors at held-out states, all of which are from that region, mean nothing
there.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import sympy as sp

from safe_envs.dynamics.lie import relative_degree
from safe_envs.dynamics.tables import tabulated
from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.number_text import finite_number
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.checks import Progress, Purpose, random_stream, require_problem
from safe_envs.wrappers.learning.data.collection import collect_paths, draw_states
from safe_envs.wrappers.learning.data.signature import Signature
from safe_envs.wrappers.learning.data.steps import Step
from safe_envs.wrappers.learning.fit import LEAST_ROWS, AdamSettings, train
from safe_envs.wrappers.learning.models.base import Record
from safe_envs.wrappers.learning.models.residual import (
    LearnedResidual,
    ResidualModel,
    lie_derivatives,
    residual_names,
)

_SHORTEST, _LONGEST = 1e-4, 100.0
"""Label steps in control periods. Of shorter ones the rounding of h takes over, over longer ones
the derivatives change."""

_MOST_DISAGREEMENT = 1e-3
"""Of derivatives below the relative degree between inputs, relative to their size: they are labels
of the same numbers."""


def learn_residual(
    problem: SafetyProblem,
    *,
    states: int = 3000,
    label_dt: float = 1e-3,
    hidden: Sequence[int] = (100, 30),
    epochs: int = 500,
    seed: int = 0,
    step: Step | None = None,
    progress: Progress | None = None,
) -> ResidualModel:
    """Learn the residuals of a problem's barriers where it is explored.

    From each state every input of the sampling domain is held for r + 2 steps, r the largest
    relative degree.

    Args:
        problem: whose plant is observed, and whose model is corrected.
        states: number of states to learn from.
        label_dt: length of a step in s.
        hidden: width of each hidden layer of the networks.
        epochs: of training, at most.
        seed: of all randomness.
        step: the plant, if it is not the problem's; a step of it has to last `label_dt` and to be
            free of noise.
        progress: called with the part that is done.

    Returns:
        The residuals of all barriers.

    Raises:
        ConfigurationError: an argument is out of its range, the plant is noisy, or the inputs
            cannot tell the residuals apart.
        RelativeDegreeError: a barrier has no relative degree.

    Source: thesis Sec. 3.4, Alg. 1, with the differences that `residual_labels` names.
    """
    began = time.perf_counter()
    require_problem(problem)
    require_whole("states", states, LEAST_ROWS)
    how = AdamSettings(hidden, epochs=epochs)
    _require_label_dt(label_dt, problem.dt)
    if step is None and problem.plant.noisy:
        raise ConfigurationError(
            f"the plant of {problem.name} is noisy, and the derivatives of a noisy path do not"
            " exist; learn with noise=0, or use ddscbf or bayesian-scbf, which are for noise"
        )
    x = draw_states(problem, states, random_stream(seed, Purpose.STATES))
    labels, transitions = residual_labels(problem, x, label_dt, seed, step)
    coordinates = problem.sampling_domain.coordinates
    inputs = tabulated(problem.plant.states, coordinates)(x)
    parts, errors = [], {}
    for i, (barrier, (targets, sizes)) in enumerate(zip(problem.barriers, labels, strict=True)):
        trained = train(
            inputs, targets, how, seed=seed, sizes=sizes, progress=_share(progress, i, len(labels))
        )
        degree = targets.shape[1] - problem.plant.m
        parts.append(
            LearnedResidual(
                problem.plant.states, coordinates, degree, trained.network, trained.heldout
            )
        )
        errors |= _summary(
            barrier.name, residual_names(degree, [u.symbol.name for u in problem.inputs]), parts[-1]
        )
    settings = {
        "states": states,
        "label_dt": label_dt,
        "hidden": list(how.hidden),
        "epochs": epochs,
    }
    record = Record(
        transitions, transitions * label_dt, time.perf_counter() - began, seed, errors, settings
    )
    # A given step may be that of any plant.
    signature = Signature.of(problem) if step is None else replace(Signature.of(problem), plant=())
    return ResidualModel(signature, record, tuple(parts))


def residual_labels(
    problem: SafetyProblem, x: np.ndarray, label_dt: float, seed: int = 0, step: Step | None = None
) -> tuple[list[tuple[np.ndarray, np.ndarray]], int]:
    """Residuals at states by forward differences along paths under held inputs.

    Derivative j of h where a path begins is a combination of all S + 1 samples, with an error of
    order label_dt^(S + 1 - j). Below the relative degree r it is the same for every input, and the
    mean is taken. Of order r, the excess over the model is Delta_r + Sigma u, solved for by least
    squares over the inputs.

    Args:
        problem: whose plant, model, barriers and sampling domain are taken.
        x: states (N, n).
        label_dt: length of a step in s.
        seed: of the plant's randomness, if it has any.
        step: the plant, if it is not the problem's.

    Returns:
        For each barrier the labels (N, r + m) of Delta_1, ..., Delta_r, Sigma_1, ..., Sigma_m, and
        the sizes (r + m,) of the plant's derivatives, of which they are a part; and the number of
        transitions that were observed.

    Raises:
        ConfigurationError: the inputs cannot tell Delta_r and Sigma apart, or an input acts on h
            before derivative r.

    Source: thesis Eq. (3.17), (3.23), (3.24), for any number of inputs. Eq. (3.28) prints the
        central second difference, half of which lies under another input: it gives half of the
        input's gain for every step.
    """
    tried = np.array(problem.sampling_domain.inputs, dtype=float)
    split = _split_by_input(problem, tried)
    degrees = [relative_degree(problem.model, b.expression) for b in problem.barriers]
    steps = max(degrees) + 2
    paths = collect_paths(
        problem,
        np.repeat(x, len(tried), axis=0),
        np.tile(tried, (len(x), 1)),
        steps,
        label_dt,
        step,
        seed,
    )
    samples = paths.reshape(-1, paths.shape[2])
    found = []
    for barrier, degree in zip(problem.barriers, degrees, strict=True):
        h = tabulated(problem.plant.states, [barrier.expression])(samples)
        rates = _differences(h.reshape(len(x), len(tried), steps + 1), degree, label_dt)
        drift, last = rates[..., :-1], rates[..., -1]
        _require_agreement(drift, barrier.name)
        measured = np.hstack((drift.mean(axis=1), last @ split.T))
        nominal = lie_derivatives(problem.model, barrier.expression, degree)(x)[:, 1:]
        found.append((measured - nominal, np.abs(measured).max(axis=0)))
    return found, len(x) * len(tried) * steps


def _require_label_dt(label_dt: float, dt: float) -> None:
    """Raise ConfigurationError unless a step of the labels suits control periods of dt s."""
    low, high = _SHORTEST * dt, _LONGEST * dt
    if not low <= finite_number("label_dt", label_dt) <= high:
        raise ConfigurationError(
            f"label_dt = {label_dt} s; give a step from {low:g} to {high:g} s, {_SHORTEST:g} to"
            f" {_LONGEST:g} control periods: over shorter ones the differences of h are rounding,"
            " over longer ones its derivatives change"
        )


def _split_by_input(problem: SafetyProblem, tried: np.ndarray) -> np.ndarray:
    """Return the matrix (1 + m, J) from values c + a u at J inputs to (c, a) by least squares."""
    # Centred and scaled, for inputs may be large and far from 0.
    center = tried.mean(axis=0)
    scale = np.abs(tried - center).max(axis=0)
    design = np.hstack(
        (np.ones((len(tried), 1)), (tried - center) / np.where(scale > 0, scale, 1.0))
    )
    if np.linalg.matrix_rank(design) < design.shape[1]:
        raise ConfigurationError(
            f"the inputs {problem.sampling_domain.inputs} of the sampling domain of {problem.name}"
            f" cannot tell {design.shape[1]} numbers apart; give {design.shape[1]} or more that do"
            " not lie in a plane"
        )
    solved = np.linalg.pinv(design)
    gains = solved[1:] / scale[:, None]
    return np.vstack((solved[0] - center @ gains, gains))


def _differences(h: np.ndarray, degree: int, dt: float) -> np.ndarray:
    """Return derivatives 1..degree at the beginning of paths with samples (..., S + 1) dt apart.

    The shape is (..., degree).
    """
    # Exact rationals, about 1 as sympy has it: weights that miss the sum 0 by a rounding would add
    # that times h/dt^j.
    table = sp.finite_diff_weights(degree, list(range(1, h.shape[-1] + 1)))
    weights = np.array([[float(w) for w in table[j][-1]] for j in range(1, degree + 1)])
    return (h - h[..., :1]) @ weights.T / dt ** np.arange(1, degree + 1)


def _require_agreement(rates: np.ndarray, name: str) -> None:
    """Raise ConfigurationError unless derivatives (N, J, r - 1) are the same for all J inputs."""
    spread = np.ptp(rates, axis=1).max(axis=0, initial=0.0)
    bad = spread > _MOST_DISAGREEMENT * np.maximum(
        np.abs(rates).max(axis=(0, 1), initial=0.0), 1e-8
    )
    if bad.any():
        raise ConfigurationError(
            f"derivative {int(bad.argmax()) + 1} of barrier {name} along the plant depends on the"
            " input, which in the model acts only on a later one; the residuals do not have the"
            " form that is learned. Check the input matrix of the model, or the noise of the plant"
        )


def _share(progress: Progress | None, part: int, parts: int) -> Progress | None:
    """Return the progress of one of some equal parts of the work."""
    return None if progress is None else lambda done: progress((part + done) / parts)


def _summary(name: str, outputs: Sequence[str], part: LearnedResidual) -> dict[str, float]:
    """Return held-out errors by name: root mean square and 95 % quantile of each residual."""
    # The quantile describes these errors; that of fresh ones, `eps`, exists for 19 held-out states
    # or more only.
    rms, q95 = (
        np.sqrt((part.heldout**2).mean(axis=0)),
        np.quantile(part.heldout, 0.95, axis=0, method="higher"),
    )
    return {
        f"{name} {out} {kind}": float(e)
        for kind, errors in (("rms", rms), ("q95", q95))
        for out, e in zip(outputs, errors, strict=True)
    }
