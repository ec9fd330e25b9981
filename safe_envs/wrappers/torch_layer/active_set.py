"""Which constraints and input bounds hold an action where it is, and the formula that follows."""

from __future__ import annotations

import numpy as np
import scipy.optimize
import torch

from safe_envs.wrappers.filter_qp import FilterQP

_RANK = 1e-9
"""Singular values below this share of the largest are the rounding of constraints that depend on
each other."""

_EXACT = 1e-11
"""How near an input at its bound is, as a share of its way there or of the input bounds."""

_NOTHING = 1e-8
"""Share of a force that is rounding."""


class ActiveSets:
    """The active sets of the decisions of a QP."""

    def __init__(self, qp: FilterQP) -> None:
        self.low, self.high = np.array(qp.low), np.array(qp.high)
        self.roots = np.sqrt(qp.weights)
        self.priorities = np.array(qp.priorities)

    def of(
        self, a: np.ndarray, v: np.ndarray, u: np.ndarray, active: np.ndarray, slack: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what holds the actions of R states.

        Args:
            a: coefficients of the constraints, shape (R, k, m).
            v: proposed inputs, shape (R, m).
            u: actions, shape (R, m).
            active: active constraints, shape (R, k).
            slack: their slacks, shape (R, k).

        Returns:
            Inputs that are held at their bounds (R, m), constraints that cannot be met, and
            constraints that bind (R, k), which are equations.
        """
        way = self.roots * (u - v)
        near = np.minimum(
            self.high - self.low, np.linalg.norm(way, axis=1, keepdims=True) / self.roots
        )
        missed = slack > 0.0
        binding = active & ~missed
        # A single constraint presses every input on which it depends.
        pressed = (way != 0.0) | ((a != 0.0) & active[:, :, None]).any(axis=1)
        held = pressed & ((u - self.low <= _EXACT * near) | (self.high - u <= _EXACT * near))
        # Several constraints may not all be needed.
        several = (np.count_nonzero(active, axis=1) > 1) | (missed.any(axis=1) & (a.shape[1] > 1))
        for i in np.flatnonzero(several):
            forced = self._forced(a[i], u[i], slack[i])
            low, high = [
                ~forced & (gap <= _EXACT * near[i]) for gap in (u[i] - self.low, self.high - u[i])
            ]
            also, binding[i] = _held_and_binding(
                a[i] / self.roots, way[i], low, high, forced, missed[i], binding[i]
            )
            held[i] = forced | also
        return held, missed, binding

    def _forced(self, a: np.ndarray, u: np.ndarray, slack: np.ndarray) -> np.ndarray:
        """Return the inputs (m,) that unmet constraints press against their bounds.

        The sum of the forces decides; a (k, m), slack (k,).
        """
        forces = (self.priorities * slack)[:, None] * a
        force, size = forces.sum(axis=0), np.abs(forces).sum(axis=0)
        gap = np.where(force > 0.0, self.high - u, u - self.low)
        return (np.abs(force) > _NOTHING * size) & (gap <= _EXACT * (self.high - self.low))


def nearest_step(
    a: torch.Tensor, gaps: torch.Tensor, weights: np.ndarray, binding: np.ndarray
) -> torch.Tensor:
    """Return the shortest steps z (R, m) that meet the binding constraints as equations.

    These are a z + gaps = 0; before, |weights (a z + gaps)|^2 is minimised.

    Args:
        a: coefficients of the constraints, in units of the weights, shape (R, k, m).
        gaps: their values at z = 0, shape (R, k).
        weights: of the constraints that cannot be met, 0 for others, shape (R, k).
        binding: constraints that bind, shape (R, k).
    """
    step = a.new_zeros(a.shape[0], a.shape[2])
    walls = a
    if weights.any():
        lost = torch.from_numpy(weights)
        compromise = lost[:, :, None] * a
        inverse = torch.linalg.pinv(compromise, rtol=_RANK)
        step = -(inverse @ (lost * gaps)[:, :, None])[:, :, 0]
        # Along these directions nothing changes for the constraints that cannot be met.
        walls = a - (a @ inverse) @ compromise
    sizes = torch.linalg.vector_norm(a.detach(), dim=-1)
    scale = torch.from_numpy(binding) / torch.where(sizes > 0.0, sizes, 1.0)
    left = scale * (gaps + (a @ step[:, :, None])[:, :, 0])
    return (
        step
        - (torch.linalg.pinv(scale[:, :, None] * walls, rtol=_RANK) @ left[:, :, None])[:, :, 0]
    )


def _held_and_binding(
    a: np.ndarray,
    way: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    fixed: np.ndarray,
    missed: np.ndarray,
    binding: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inputs (m,) and constraints (k,) that hold the action of one state where it is.

    The signs of their multipliers say so.

    The way from the proposal to the action is a nonnegative sum of the normals of the constraints
    that bind and of the input bounds, and of those of the missed constraints in either direction,
    since the way must not change what these miss. Nonnegative least squares uses independent ones
    only.

    Args:
        a: coefficients in units of the weights, shape (k, m).
        way: from the proposal to the action, in the same units, shape (m,).
        low: inputs that may be held at their lower bounds, shape (m,).
        high: inputs that may be held at their upper bounds, shape (m,).
        fixed: inputs that are held in any case, shape (m,).
        missed: constraints that cannot be met, shape (k,).
        binding: constraints that may bind, shape (k,).
    """
    left, m = ~fixed, len(way)
    size = np.abs(way[left]).max(initial=0.0)
    if size == 0.0:
        return np.zeros(m, dtype=bool), binding
    lengths = np.linalg.norm(a[:, left], axis=1)
    units = a / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    normals = np.concatenate([units, -units, np.eye(m), -np.eye(m)])
    candidates = np.flatnonzero(np.concatenate([binding | missed, missed, low, high]))
    shares = np.zeros(len(normals))
    shares[candidates] = scipy.optimize.nnls(normals[np.ix_(candidates, left)].T, way[left] / size)[
        0
    ]
    of_rows, _, of_low, of_high = np.split(shares > _NOTHING, np.cumsum([len(a), len(a), m]))
    return of_low | of_high, of_rows & binding
