"""Constraints that hold along the period for which their input is held.

A constraint a u + b >= 0 with a margin of first order changes at a rate that is quadratic in the
held input. To first order its value at the end of the period dt is

    q(u) = a u + b + dt (c_0 + c u + u' C u),

so that it holds all along the period where a u + b >= 0 and q(u) >= 0: two constraints, of which
one is quadratic. Where the input that the constraints allow at its beginning violates one of them,
each round takes one step of Newton's method: they are linearised there, and the QP proposes another
input. On the line through both inputs all constraints are known in closed form, and the step ends
at the nearest input at which all of them hold. Where there is none on the line, it ends where their
squared violations are least among their roots and vertices and what the QP proposed; where that
helps little, lines along each input are tried. So for one input one step finds the nearest one,
whatever the curvatures; several inputs end at one that has been checked, which need not be the
nearest.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from safe_envs.wrappers.filter_qp.period_constraints import PeriodConstraints
from safe_envs.wrappers.qp.rounding import ROUNDING

ROUNDS = 12
"""Of Newton's method; it stops where all constraints hold, or where a round does not help."""
ENOUGH = 0.9
"""Share of the squared violations that is left by a round after which another one is tried."""
SLOW = 0.25
"""Share of them that is left by a step after which lines along each input are tried."""
INWARDS = 1e-8
"""Share of its terms without input by which a constraint at the end of the period has to exceed 0.
A filter that rides the edge would else be carried beyond it by the errors of integrators."""


def constraints_of_period(
    a: Sequence[Sequence[Any]], b: Sequence[Any], falls: Mapping[int, Sequence[Any]]
) -> tuple[list[list[Any]], list[int]]:
    """Return constraints at the beginning of a period and at its end, and of which each is.

    Args:
        a: m coefficients of each of k constraints.
        b: k offsets.
        falls: by the number of the constraint, the coefficients of its change within the period.
    """
    constraints = [[bi, *ai] for ai, bi in zip(a, b, strict=True)]
    for i, fall in falls.items():
        offset = b[i] + fall[0] - INWARDS * (abs(b[i]) + abs(fall[0]))
        slopes = [aj + cj for aj, cj in zip(a[i], fall[1:], strict=False)]
        constraints.append([offset, *slopes, *fall[1 + len(slopes) :]])
    return constraints, [*range(len(b)), *falls]


class PeriodSearch:
    """Moves inputs to where constraints hold.

    Args:
        constraints: the constraints.
        owners: of which constraint each is at the beginning or at the end, which come last.
        project: projects inputs; see `safe_envs.wrappers.qp.dispatch`.
        bounds: m lower and m upper bounds.
        w: m weights of the inputs.
    """

    def __init__(
        self,
        constraints: PeriodConstraints,
        owners: Sequence[int],
        project: Callable[..., Any],
        bounds: Sequence[Sequence[Any]],
        w: Sequence[float],
    ) -> None:
        self._constraints, self._owners, self._project = constraints, owners, project
        self._bounds, self._w = bounds, w

    def hold(
        self, u: Sequence[Any], active: Sequence[Any], known: Sequence[Any], rounds: int = ROUNDS
    ) -> tuple[list[Any], list[Any], list[Any], Any]:
        """Move an input to where the constraints hold.

        Args:
            u: m components of the input.
            active: which constraints have changed it so far.
            known: values of the constraints there, as far as they are known.
            rounds: how many there may be.

        Returns:
            The input, the lesser value of each constraint, which have changed the input, and
            whether all constraints hold.
        """
        alone = self._constraints.alone
        u, active, margin, kept = list(u), list(active), list(known), []
        for n, i in enumerate(self._owners):
            value = known[n] if n < len(known) else self._value(n, u)
            some = (value < 0.0) if alone else np.any(~(value >= 0.0))
            kept.append(value >= -self._allowed(n, u) if some else value >= 0.0)
            if i < n:
                margin[i] = self._constraints.choose(value < margin[i], value, margin[i])
            elif n >= len(known):
                margin.append(value)
            active[i] = self._constraints.choose(kept[n], active[i], True)
        met: Any = all(kept) if alone else functools.reduce(operator.and_, kept)
        if not rounds or (met if alone else met.all()):
            return u, margin, active, met
        if alone:
            u, left = self._round(u)
            return self.hold(u, active, (), rounds - 1 if left < ENOUGH else 0)
        # Each state has the rounds that it would have alone.
        lost = np.flatnonzero(~met)
        part, inputs = self._of(lost), _take(u, lost)
        inputs, left = part._round(inputs)
        for going in (True, False):
            which = np.flatnonzero((left < ENOUGH) == going)
            if which.size:
                place, some = lost[which], (_take(inputs, which), _take(active, lost[which]))
                found = part._of(which).hold(*some, (), rounds - 1 if going else 0)
                for whole, entries in zip((u, margin, active), found[:3], strict=True):
                    for n, entry in enumerate(entries):
                        whole[n] = _put(whole[n], place, entry, len(met))
                met[place] = found[3]
        return u, margin, active, met

    def _of(self, which: np.ndarray) -> PeriodSearch:
        """Return the constraints of some states of a batch."""
        constraints = self._constraints
        forms = {i: _take(form, which) for i, form in constraints.forms.items()}
        some = PeriodConstraints(
            [_take(constraint, which) for constraint in constraints.coefficients],
            forms,
            constraints.priorities,
            constraints.flavour,
            constraints.m,
        )
        bounds = [_take(end, which) for end in self._bounds]
        return PeriodSearch(some, self._owners, self._project, bounds, self._w)

    def _value(self, i: int, u: Sequence[Any]) -> Any:
        """Return the value of a constraint."""
        value = self._constraints.coefficients[i][0]
        for cj, uj in zip(self._constraints.coefficients[i][1:], u, strict=False):
            value = value + cj * uj
        for c, j, n in self._constraints.bends[i]:
            value = value + c * u[j] * u[n]
        return value - self._root(i, u[0])[0] if i in self._constraints.forms else value

    def _allowed(self, i: int, u: Sequence[Any]) -> Any:
        """Return by how much a constraint may be violated and count as met."""
        size = abs(self._constraints.coefficients[i][0])
        for cj, uj in zip(self._constraints.coefficients[i][1:], u, strict=False):
            size = size + abs(cj * uj)
        for c, j, n in self._constraints.bends[i]:
            size = size + abs(c * u[j] * u[n])
        blur = self._root(i, u[0])[2] if i in self._constraints.forms else 0.0
        return ROUNDING * size + blur

    def _root(self, i: int, u: Any) -> tuple[Any, Any, Any]:
        """Return the root of an uncertainty, its slope, and the error of its rounding."""
        constraints, (q0, q1, q2) = self._constraints, self._constraints.forms[i]
        linear, square = 2.0 * q1 * u, q2 * u * u
        inside = constraints.larger(q0 + linear + square, 0.0)
        root, error = constraints.square_root(inside), ROUNDING * (abs(q0) + abs(linear) + square)
        blur = constraints.choose(inside > 0.0, constraints.square_root(inside + error) - root, 0.0)
        return root, constraints.ratio(q1 + q2 * u, root), blur

    def _linear(self, u: Sequence[Any]) -> tuple[list[list[Any]], list[Any]]:
        """Return the slopes and offsets of the constraints, linearised at an input."""
        slopes, offsets = [], []
        for i, constraint in enumerate(self._constraints.coefficients):
            offset, along = constraint[0], list(constraint[1 : 1 + len(u)])
            for c, j, n in self._constraints.bends[i]:
                offset = offset - c * u[j] * u[n]
                along[j] = along[j] + c * u[n]
                along[n] = along[n] + c * u[j]
            if i in self._constraints.forms:
                root, steepness, _ = self._root(i, u[0])
                along, offset = [along[0] - steepness], offset + (steepness * u[0] - root)
            slopes.append(along)
            offsets.append(offset)
        return slopes, offsets

    def _round(self, u: Sequence[Any]) -> tuple[list[Any], Any]:
        """Take a step, and others where it helps little; return the input and what is left."""
        constraints = self._constraints
        v = self._project(*self._linear(u), u, *self._bounds, self._w, constraints.priorities)[0]
        u, left = constraints.step(u, v, *self._bounds)
        slow = constraints.choose(left > SLOW, 1.0, 0.0)
        for j in range(constraints.m if constraints.m > 1 and np.any(slow) else 0):
            axis = [uj + slow * (n == j) for n, uj in enumerate(u)]
            u, more = constraints.step(u, axis, *self._bounds)
            left = left * more
        return u, left


def _take(entries: Sequence[Any], which: np.ndarray) -> list[Any]:
    """Return the numbers of some states; those of all have no axis."""
    return [entry[which] if np.ndim(entry) else entry for entry in entries]


def _put(entry: Any, place: np.ndarray, some: Any, count: int) -> np.ndarray:
    """Return numbers of a batch with other ones in the place of some."""
    found = np.array(np.broadcast_to(entry, count))
    found[place] = some
    return found
