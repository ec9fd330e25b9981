"""Filters of everything that a filter may have, and what holds their decisions together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy as sp

from safe_envs import CLF, Barrier, ControlAffineSDE
from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.slots import Data
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import CBF, RCBF, SRCBF, AffineConstraint, SafetyFilter
from tests.oracles.programs import decision_of
from tests.wrappers.learned import Terms

x, y, z, s, u, v, w = sp.symbols("x y z s u v w", real=True)
KINDS = {"idle", "met", "missed"}


def situations(problem: SafetyProblem, count: int) -> tuple[np.ndarray, np.ndarray]:
    """States in and around the region of a problem, with proposals in and around its box."""
    rng = np.random.default_rng(0)
    found = []
    for ranges, beyond in ((problem.sampling_domain.region, 0.2), (problem.input_bounds, 0.5)):
        low, high = np.array(ranges).T
        shares = rng.uniform(-beyond, 1.0 + beyond, (count, len(low)))
        found.append(low + (high - low) * shares)
    return found[0], found[1]


def check(
    safety_filter: SafetyFilter,
    states: np.ndarray,
    inputs: np.ndarray,
    most: int = 3,
    *,
    compiled: bool = False,
) -> set[str]:
    """Compare what is decided for a batch, for one state and by the program, at `most` states of
    each kind; return the kinds."""
    qp = safety_filter.qp
    batch = safety_filter.filter(states, inputs)
    acts = batch.active.any(axis=1)
    kinds = np.where(batch.feasible, np.where(acts, "met", "idle"), "missed")
    decide = decision_of(safety_filter, compiled=compiled)
    size = max(abs(bound) for bound in (*qp.low, *qp.high))
    # Of constraints that contradict each other, and of three inputs, each way has a method of its
    # own; networks add sums in another order.
    error = (1e-10 if len(qp.low) + (qp.clf is not None) > 2 else 1e-12) * size
    for kind in KINDS:
        for i in np.flatnonzero(kinds == kind)[:most]:
            single, program = (
                safety_filter.filter(states[i], inputs[i]),
                decide(states[i], inputs[i]),
            )
            assert program.sound
            for found in (single, program):
                np.testing.assert_allclose(found.action, batch.action[i], rtol=0.0, atol=error)
                np.testing.assert_allclose(
                    found.proposed, batch.proposed[i], rtol=1e-12, atol=1e-12 * size
                )
                np.testing.assert_allclose(found.slack, batch.slack[i], rtol=1e-9, atol=1e-12)
                assert (np.any(found.active), found.feasible) == (acts[i], batch.feasible[i])
                assert found.cause == batch.cause[i] or not acts[i]
            assert single.active.tolist() == batch.active[i].tolist()
    return set(kinds)


@dataclass(frozen=True)
class Doubtful(CBF):
    """A constraint that is known up to an error, whose form is as given."""

    form: tuple[Any, ...] = ()

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        form = tuple(map(sp.sympify, self.form))
        return replace(super().derived(model, barrier), uncertainty=form)


@dataclass(frozen=True)
class Corrected(CBF):
    """A constraint with learned terms in its coefficients and its offset."""

    learned: Any = None

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        found = super().derived(model, barrier)
        slope, *more = self.learned.symbols
        return replace(
            found,
            coefficient=tuple(c * slope for c in found.coefficient),
            offset=found.offset + sum(more),
            terms=self.learned,
        )


class Measured(Terms):
    """Given functions in the place of a network, which programs have, too."""

    def __init__(self, system: ControlAffineSDE, expressions: Sequence[Any]) -> None:
        super().__init__(system, 1, expressions)
        self._formulas = {"x": system.states}, expressions

    def source(self, name: str, data: Data) -> Source:
        inner = formulas(f"{name}_inner", *self._formulas, data)
        return inner + Source(
            f"def {name}(x, data, work):\n    work[0] = 7.0\n    return {name}_inner(x, data)\n",
            work=1,
        )


def integrators(m: int) -> ControlAffineSDE:
    """A state for each of up to three inputs, and one more that falls, with noise in the first."""
    states, inputs = (*(x, y, z)[:m], s), (u, v, w)[:m]
    gains = [[1 if i == j else 0 for j in range(m)] for i in range(m)] + [[0] * m]
    return ControlAffineSDE(states, inputs, [0] * m + [-s], gains, [0.3] + [0] * m)


CURVED, STEEP, SLANTED = 2 - x**2 + 0.3 * s * x, 1 + 2 * x + s**2, 1 - x * s + s
ROUND, TILTED, ACROSS = 2 - x**2 - y**2, 1 + x + 0.5 * y + x * y, 1.5 - y + 0.2 * s * x
EARLY = {"sampling_margin": "first-order"}
ONE = Measured(integrators(1), [1.2 + sp.sin(x), 0.1 * s])
OTHER = Measured(integrators(1), [1 - s**2 / 9, x, s])
LIGHT, HEAVY = {"weights": (5.0, 0.2, 1.0)}, {"weights": (5.0, 0.2)}
BALL, ABOVE = (ROUND - z**2, CBF(1.0)), (ACROSS - z, CBF(0.5))
ABOUT = (ROUND, Doubtful(1.0, form=(0.1, 0, 0, 0.2, 0.1, 0.2)))
SLOPING = (x**2, x * s / 4, 0, 0.2 + s**2, 0.1, 0.2)
CASES: dict[str, tuple[int, list[tuple[Any, Any]], dict[str, Any]]] = {
    "one reciprocal": (1, [(CURVED, SRCBF(0.7))], {}),
    "one sampled": (1, [(CURVED, CBF(1.0, **EARLY))], {}),
    "one on three inputs": (3, [(CURVED + y - z**2, CBF(1.0))], {"weights": (1.0, 3.0, 0.5)}),
    "several on three": (3, [BALL, (TILTED + z, CBF(2.0, **EARLY)), ABOVE], LIGHT),
    "reciprocal among several on three": (3, [BALL, (TILTED + z, RCBF(2.0)), ABOVE], {}),
    "reciprocal on three": (3, [(CURVED + y - z**2, RCBF(1.0))], {"weights": (1.0, 3.0, 0.5)}),
    "sampled on three": (3, [(CURVED + y - z**2, CBF(1.0, **EARLY))], {}),
    "several": (1, [(CURVED, CBF(1.0)), (STEEP, CBF(0.5)), (SLANTED, CBF(2.0, **EARLY))], {}),
    "early reciprocal": (1, [(CURVED, RCBF(1.0, **EARLY)), (STEEP, CBF(1.0, **EARLY))], {}),
    "several reciprocal": (1, [(CURVED, RCBF(1.0)), (STEEP, CBF(0.5)), (SLANTED, SRCBF(2.0))], {}),
    "plane": (2, [(ROUND, CBF(1.0)), (TILTED, CBF(2.0, **EARLY)), (ACROSS, CBF(0.5))], HEAVY),
    "reciprocal in a plane": (
        2,
        [(ROUND, RCBF(1.0)), (TILTED, SRCBF(1.0)), (ACROSS, CBF(0.5))],
        {},
    ),
    "goal": (1, [(CURVED, CBF(1.0))], {"clf": CLF((x - 3) ** 2, input_weight=0.5)}),
    "goal of several": (
        1,
        [(CURVED, RCBF(1.0)), (STEEP, Doubtful(0.5, form=(x**2, 0, 0.1))), (SLANTED, CBF(2.0))],
        {"clf": CLF((x - 1) ** 2 + s**2, slack_weight=4.0)},
    ),
    "goal on two": (2, [(ROUND, CBF(1.0))], {"clf": CLF((x - 3) ** 2 + y**2)}),
    "goal of several on two": (
        2,
        [(ROUND, RCBF(1.0)), (TILTED, CBF(2.0, **EARLY)), (ACROSS, CBF(0.5))],
        {"clf": CLF((x - 1) ** 2 + (y + s) ** 2, slack_weight=4.0)},
    ),
    "uncertain": (1, [(CURVED, Doubtful(1.0, form=(0.1, 0.02, 0.3)))], {}),
    "several uncertain": (
        1,
        [(CURVED, CBF(1.0, **EARLY)), (STEEP, Doubtful(0.5, form=(0.1 + x**2, 0.05, 0.3)))],
        {},
    ),
    "plane above": (2, [ABOUT], {}),
    "planes above": (2, [ABOUT, (TILTED, Doubtful(1.0, form=SLOPING))], {}),
    "minimum": (1, [(sp.Min(CURVED, STEEP), CBF(1.0)), (SLANTED, CBF(2.0, **EARLY))], {}),
    "reciprocal minimum": (2, [(sp.Min(ROUND, TILTED), RCBF(1.0)), (ACROSS, CBF(0.5))], {}),
    "maximum": (1, [(sp.Max(CURVED, SLANTED), CBF(1.0))], {}),
    "maximum in a plane": (
        2,
        [(TILTED, CBF(2.0, **EARLY)), (sp.Max(ROUND, ACROSS, -x), CBF(1.0))],
        HEAVY,
    ),
    "maxima on three": (
        3,
        [(sp.Min(sp.Max(ROUND, -z), TILTED + z), CBF(1.0)), (sp.Max(CURVED, z), CBF(0.5))],
        {},
    ),
    "goal of a maximum": (1, [(sp.Max(CURVED, SLANTED), CBF(1.0))], {"clf": CLF((x - 3) ** 2)}),
    "learned": (1, [(CURVED, Corrected(1.0, learned=ONE))], {}),
    "several learned": (
        1,
        [
            (CURVED, Corrected(1.0, learned=ONE, **EARLY)),
            (STEEP, Corrected(0.5, learned=OTHER)),
            (SLANTED, Corrected(2.0, learned=ONE)),
        ],
        {},
    ),
}


def case_of(name: str) -> tuple[SafetyFilter, np.ndarray, np.ndarray]:
    """A filter, states, and proposals."""
    m, pairs, options = CASES[name]
    rng = np.random.default_rng(1)
    safety_filter = SafetyFilter(
        integrators(m),
        [(Barrier(h, name=f"h_{i}"), condition) for i, (h, condition) in enumerate(pairs)],
        input_bounds=[(-1.0, 1.5), (-2.0, 0.5), (-1.0, 1.0)][:m],
        priorities=[1.0, 4.0, 0.3][: len(pairs)],
        dt=0.05,
        **options,
    )
    return safety_filter, 1.5 * rng.normal(size=(300, m + 1)), 2.0 * rng.normal(size=(300, m))
