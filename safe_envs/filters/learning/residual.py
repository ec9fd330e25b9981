"""Learning what a model gets wrong in the derivatives of a barrier, from short paths of the plant.

A network says something everywhere, but it has seen states of the explored region only. Outside it
extrapolates, and the errors at held-out states, all of which are from that region, mean nothing
there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import tabulated
from safe_envs.dynamics.lie import relative_degree
from safe_envs.errors import ConfigurationError, InvalidInputError, require_whole, shown
from safe_envs.filters.learning.checks import Progress, Purpose, random_stream, require_problem
from safe_envs.filters.learning.collection import Step, collect_paths, draw_states
from safe_envs.filters.learning.data import LARGEST, Signature
from safe_envs.filters.learning.models.base import Record
from safe_envs.filters.learning.models.network import Activation, Network, require_activation
from safe_envs.filters.learning.models.residual import (
    LearnedResidual,
    ResidualModel,
    lie_derivatives,
    residual_names,
)
from safe_envs.problem.problem import SafetyProblem
from safe_envs.text import finite_number

LEAST_ROWS = 10
"""Fewest rows from which anything is learned."""

_MOST_PARAMETERS = 10_000_000
"""Of a network: Adam keeps four numbers for each, and half a thousand epochs take hours."""

_PATIENCE = 60
_TRAINED, _VALIDATED = 0.7, 0.15

_ROUNDING = 64 * np.finfo(float).eps
"""Part of its largest entry by which a target may vary and still be constant."""


@dataclass(frozen=True, eq=False)
class Trained:
    """A network and how well it was trained.

    Attributes:
        network: with the weights of the epoch of least validation loss; a constant for each target
            that is one.
        epochs: that were run; none where there are only constants.
        validation_loss: the least one: mean squared error of the standardised targets.
        heldout: absolute errors (N_h, q) at rows that neither the training nor the choice of the
            epoch has seen, in the units of the targets.
    """

    network: Network
    epochs: int
    validation_loss: float
    heldout: np.ndarray


@dataclass(frozen=True)
class AdamSettings:
    """Layers of a network, and how Adam trains it.

    Attributes:
        hidden: width of each hidden layer.
        activation: after each of them.
        epochs: at most; training stops when the validation loss has not fallen for 60 of them.
        batch: rows in a step.
        rate: of Adam.

    Raises:
        ConfigurationError: a setting is out of its range.
    """

    hidden: Sequence[int] = (100, 30)
    activation: Activation = "relu"
    epochs: int = 500
    batch: int = 256
    rate: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("epochs", "batch"):
            require_whole(name, getattr(self, name), 1)
        object.__setattr__(self, "hidden", _widths(self.hidden))
        require_activation(self.activation)
        if not 0 < self.rate < 1:
            raise ConfigurationError(f"rate = {shown(self.rate)}; give a number between 0 and 1")


def train(
    inputs: np.ndarray,
    targets: np.ndarray,
    settings: AdamSettings | None = None,
    *,
    seed: int = 0,
    sizes: np.ndarray | None = None,
    progress: Progress | None = None,
) -> Trained:
    """Fit a network: 70 % of the rows train it, 15 % choose the epoch, 15 % measure it.

    One thread and no global generator are used. A target that is the same in all rows, up to
    rounding, is answered by this constant: of a barrier to which the noise adds nothing, a network
    would learn its own error.

    Args:
        inputs: (N, p).
        targets: (N, q).
        settings: of the training; by default those of `AdamSettings`.
        seed: of the split, the first weights and the order of the rows; the same seed gives the
            same network.
        sizes: (q,), against which the spread of each target is judged small (see
            `_standardisation`); its largest entry by default.
        progress: called after each epoch.

    Returns:
        The network of the epoch of least validation loss, with its errors.

    Raises:
        InvalidInputError: the arrays have other shapes, fewer than ten rows, or entries that are
            not finite or above 1e100.
        ConfigurationError: the seed is out of its range, or the network would have more than ten
            million parameters.

    Source: thesis Sec. 3.4.2, whose loss lacks the square and whose update has the wrong sign.
    """
    _check_data(inputs, targets)
    how = settings or AdamSettings()
    widths = (inputs.shape[1], *how.hidden, targets.shape[1])
    _require_size(widths)
    rows = random_stream(seed, Purpose.TRAINING).permutation(len(inputs))
    fitted, validated = int(_TRAINED * len(rows)), int(_VALIDATED * len(rows))
    parts = np.split(rows, [fitted, fitted + validated])
    ends = (*_standardisation(inputs), *_standardisation(targets, sizes))
    x, y = (inputs - ends[0]) / ends[1], (targets - ends[2]) / ends[3]
    constant = np.ptp(targets, axis=0) <= _ROUNDING * np.abs(targets).max(axis=0)
    with _single_thread():
        allowed = 0 if constant.all() else how.epochs
        layers, run, loss = _fit(x, y, parts, how, allowed, int(seed), progress)
    # In the last layer, whose output the mean is added to.
    for numbers in layers[-1]:
        numbers[constant] = 0.0
    network = Network(
        tuple(w for w, _ in layers), tuple(b for _, b in layers), how.activation, *ends
    )
    predicted = np.stack(network.arrays(tuple(inputs[parts[2]].T)), axis=1)
    return Trained(
        network, run, 0.0 if constant.all() else loss, np.abs(predicted - targets[parts[2]])
    )


def _widths(hidden: Any) -> tuple[int, ...]:
    """Return the widths of hidden layers as Python's numbers."""
    try:
        widths = tuple(hidden)
    except TypeError as error:
        raise ConfigurationError(
            f"hidden = {shown(hidden)}; give the width of each hidden layer, such as (100, 30) or"
            " (100,)"
        ) from error
    for width in widths:
        require_whole("the width of a hidden layer", width, 1)
    return tuple(map(int, widths))


def _require_size(widths: Sequence[int]) -> None:
    """Raise ConfigurationError where layers between these widths have too many parameters."""
    parameters = sum((into + 1) * out for into, out in pairwise(widths))
    if parameters > _MOST_PARAMETERS:
        raise ConfigurationError(
            f"hidden = {list(widths[1:-1])} makes a network of {parameters:.3g} parameters; at most"
            f" {_MOST_PARAMETERS} are allowed: give narrower hidden layers"
        )


def _check_data(inputs: np.ndarray, targets: np.ndarray) -> None:
    if (
        inputs.ndim != 2
        or targets.ndim != 2
        or len(inputs) != len(targets)
        or not inputs.size
        or not targets.size
    ):
        raise InvalidInputError(
            f"inputs and targets have the shapes {inputs.shape} and {targets.shape}; give (N, p)"
            " and (N, q)"
        )
    if len(inputs) < LEAST_ROWS:
        raise InvalidInputError(f"{len(inputs)} rows to learn from; give at least {LEAST_ROWS}")
    if not all((np.abs(columns) <= LARGEST).all() for columns in (inputs, targets)):
        raise InvalidInputError(f"inputs or targets are not finite, or larger than {LARGEST:g}")


def _standardisation(
    columns: np.ndarray, sizes: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and scale of each column (N, k)."""
    # A column that should be constant, such as Delta_2 of a Dubins vehicle, still varies by the
    # rounding and truncation of its labels, up to about 1e-5 of its size. Divided by its own
    # deviation, that noise would weigh as much in the loss as a signal; so the scale is at least
    # 1e-4 of the size. The network can still follow such a column, to a fraction of that. There is
    # no absolute floor: units may make a signal as small as they like.
    least = 1e-4 * (np.abs(columns).max(axis=0) if sizes is None else sizes)
    scale = np.maximum(columns.std(axis=0), least)
    return columns.mean(axis=0), np.where(scale > 0, scale, 1.0)


@contextmanager
def _single_thread() -> Iterator[None]:
    """Let torch use one thread: more are slower on small matrices, and change the order of sums."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _fit(
    x: np.ndarray,
    y: np.ndarray,
    parts: Sequence[np.ndarray],
    how: AdamSettings,
    epochs: int,
    seed: int,
    progress: Progress | None,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], int, float]:
    """Train on standardised data; return weights and biases, the epochs and the validation loss."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    (x_fit, x_val), (y_fit, y_val) = (
        [torch.tensor(a[part], dtype=torch.float32) for part in parts[:2]] for a in (x, y)
    )
    widths = (x.shape[1], *how.hidden, y.shape[1])
    shapes = [shape for into, out in pairwise(widths) for shape in ((out, into), (out,))]
    # All parameters in one tensor: Adam's cost is in the number of its calls, not in the size of
    # what it updates.
    flat = _first_parameters(shapes, generator).requires_grad_()
    optimizer = torch.optim.Adam([flat], lr=how.rate)
    loss_of = torch.nn.functional.mse_loss
    best, least, since, epoch = flat.detach().clone(), float("inf"), 0, 0
    for epoch in range(1, epochs + 1):
        for rows in torch.randperm(len(x_fit), generator=generator).split(how.batch):
            optimizer.zero_grad()
            loss_of(
                _forward(_unpacked(flat, shapes), x_fit[rows], how.activation), y_fit[rows]
            ).backward()
            optimizer.step()
        with torch.no_grad():
            loss = loss_of(_forward(_unpacked(flat, shapes), x_val, how.activation), y_val).item()
        since += 1
        if loss < least:
            best, least, since = flat.detach().clone(), loss, 0
        if progress is not None:
            progress(epoch / epochs)
        if since >= _PATIENCE:
            break
    numbers = [p.numpy().astype(float) for p in _unpacked(best, shapes)]
    return list(zip(numbers[::2], numbers[1::2], strict=True)), epoch, least


def _first_parameters(shapes: Sequence[tuple[int, ...]], generator: Any) -> Any:
    """Draw all weights and biases into one tensor, uniform within 1/sqrt(inputs of the layer)."""
    import torch

    bounds = [weights[1] ** -0.5 for weights in shapes[::2] for _ in range(2)]
    parts = zip(shapes, bounds, strict=True)
    return torch.cat(
        [
            torch.empty(math.prod(shape)).uniform_(-bound, bound, generator=generator)
            for shape, bound in parts
        ]
    )


def _unpacked(flat: Any, shapes: Sequence[tuple[int, ...]]) -> list[Any]:
    """Yield weights and bias of each layer in turn, as views of the tensor that holds them all."""
    return [
        part.view(shape)
        for part, shape in zip(flat.split([math.prod(s) for s in shapes]), shapes, strict=True)
    ]


def _forward(parameters: Sequence[Any], x: Any, activation: Activation) -> Any:
    """Return the outputs of the layers for a batch, as tensors."""
    import torch

    for k in range(0, len(parameters), 2):
        x = torch.nn.functional.linear(x, parameters[k], parameters[k + 1])
        if k + 2 < len(parameters):
            x = torch.relu(x) if activation == "relu" else torch.tanh(x)
    return x


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
    """Return derivatives 1..degree at the beginning of paths with samples (..., S + 1) dt apart."""
    # The shape is (..., degree).
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
