"""What data cannot tell about a system: inputs without excitation, features that look alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components

from safe_envs.wrappers.learning.models.distributions import Gaussian
from safe_envs.wrappers.learning.models.features import Features

_STILL = 1e-8
"""Part of its range that a state has to cover."""

_STEADY = 0.05
"""Part of its largest size by which an input has to vary."""

_RANK = 1e-8
"""Singular values below this part of the largest count as zero."""

_WEAK = 0.5
"""Part of the prior variance above which a direction counts as not learned."""

_PART = 0.05
"""Share of a weight in a direction from which it is named."""

_MATERIAL = 0.05
"""Part of a state's rate, or of its noise, from which there is a warning of a misfit."""

_MOST_NAMED = 4


class IdentifiabilityWarning(UserWarning):
    """The data do not tell everything that was asked of them."""


def weaknesses(
    features: Features,
    inputs: Sequence[str],
    x: np.ndarray,
    u: np.ndarray,
    design: np.ndarray,
    learned: Gaussian,
    prior: float,
) -> tuple[str, ...]:
    """Say what the data leave open.

    Args:
        features: M of them.
        inputs: names of the inputs.
        x: distinct rows of data: states (P, n),
        u: and inputs (P, m).
        design: of the regression at these rows, (P, D) with D = M (1 + m).
        learned: the posterior of the weights.
        prior: variance of each weight before.

    Returns:
        Texts; none where the data tell everything.

    Source: our own; thesis Sec. 6.3.1 tries u = .1 only, which does not identify g.
    """
    terms = term_names(features, inputs)
    found = [*_steady(features, inputs, x, u)]
    if len(design) < len(terms):
        found.append(
            f"{len(design)} different rows of data are too few for {len(terms)} weights; collect"
            " more, or lower the degree"
        )
    _, singular, right = np.linalg.svd(np.linalg.qr(design, mode="r"), full_matrices=True)
    rank = int((singular > _RANK * singular[0]).sum()) if singular[0] > 0 else 0
    if rank < len(terms):
        found.append(
            f"the data cannot tell apart: {_confounded(terms, right[rank:])}; what is learned of"
            " these is the prior's choice"
        )
    weak = _weak(terms, right[:rank], learned, prior)
    return (
        *found,
        *(
            f"{state}: the noise drowns {names}; observe longer, or try larger inputs"
            for state, names in _by_state(features, weak)
        ),
    )


def misfits(features: Features, misfit: np.ndarray, variation: np.ndarray) -> tuple[str, ...]:
    """Say what the features leave out.

    Args:
        features: of the regression.
        misfit: part of each state's rate that they miss, (n,).
        variation: part by which the variance of its noise varies although it is taken for constant,
            (n,).

    Returns:
        Texts; none where nothing material is left out.
    """
    left_out = [
        f"{state}: features of degree {features.degree} miss {100 * part:.3g} % of its rate; give a"
        " higher degree"
        for state, part in zip(features.states, misfit, strict=True)
        if part > _MATERIAL
    ]
    varied = [
        f"{state}: the variance of its noise varies by {100 * part:.3g} % over the states; give a"
        " diffusion degree"
        for state, part in zip(features.states, variation, strict=True)
        if part > _MATERIAL
    ]
    return (*left_out, *varied)


def term_names(features: Features, inputs: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the D columns of the regression: monomials, then these times each input.

    Args:
        features: of the states.
        inputs: names of the m inputs.
    """
    # Whatever the ranges are, the order of the monomials is the same: on [-1, 1] their names are
    # short.
    plain = Features(
        features.states, ((-1.0, 1.0),) * len(features.states), features.degree, features.angles
    )
    names = [
        str(e.as_coeff_Mul()[1]).replace("**", "^").replace("*", " ") for e in plain.expressions
    ]
    return (*names, *(u if name == "1" else f"{u} {name}" for u in inputs for name in names))


def _steady(features: Features, inputs: Sequence[str], x: np.ndarray, u: np.ndarray) -> list[str]:
    found = []
    for state, (low, high), values in zip(features.states, features.region, x.T, strict=True):
        if np.ptp(values) <= _STILL * (high - low):
            found.append(
                f"the state {state} is always {values[0]:g}: how anything depends on it cannot be"
                " learned"
            )
    for name, values in zip(inputs, u.T, strict=True):
        if np.ptp(values) <= _STEADY * abs(values).max():
            found.append(
                f"the input {name} stays within [{values.min() + 0.0:g}, {values.max() + 0.0:g}]:"
                " its effect cannot be told from the drift; try values of both signs"
            )
    return found


def _confounded(terms: Sequence[str], null: np.ndarray) -> str:
    """Return the groups of terms that mix in the null space with orthonormal basis (d, D)."""
    projector = null.T @ null
    involved = np.flatnonzero(projector.diagonal() > _PART)
    count, group = connected_components(
        abs(projector[np.ix_(involved, involved)]) > _PART, directed=False
    )
    members: list[list[str]] = [[terms[int(k)] for k in involved[group == g]] for g in range(count)]
    texts = [
        " and ".join(_shortened(m)) if len(m) > 1 else f"{m[0]} (never excited)" for m in members
    ]
    return "; ".join(_shortened(texts))


def _weak(
    terms: Sequence[str], seen: np.ndarray, learned: Gaussian, prior: float
) -> list[tuple[str, ...]]:
    """Return for each output the terms in directions that the data hardly show.

    `seen` (r, D) is a basis of the directions that they show at all.
    """
    values, vectors = np.linalg.eigh(seen @ learned.covariance @ seen.T)
    found = []
    for sizes, directions in zip(values, vectors, strict=True):
        weights = (seen.T @ directions[:, sizes > _WEAK * prior]) ** 2
        found.append(tuple(terms[int(k)] for k in np.flatnonzero(weights.sum(axis=1) > _PART)))
    return found


def _by_state(features: Features, weak: list[tuple[str, ...]]) -> list[tuple[str, str]]:
    """Names of the states with the same weak terms, and these."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for state, names in zip(features.states, weak, strict=True):
        if names:
            groups.setdefault(names, []).append(state.name)
    return [(", ".join(states), ", ".join(_shortened(names))) for names, states in groups.items()]


def _shortened(names: Sequence[str]) -> list[str]:
    left = len(names) - _MOST_NAMED
    return [*names[:_MOST_NAMED], *([f"{left} more"] if left > 0 else [])]
