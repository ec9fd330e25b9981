"""The Kalman filter of linear systems and the extended one, continuous in time between samples.

The same code serves floats of one state and arrays of a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, lru_cache
from typing import Any

import sympy as sp

from safe_envs.dynamics.codegen import Flavour, compile_function
from safe_envs.dynamics.integrators import rate
from safe_envs.errors import ConfigurationError
from safe_envs.filters.estimation.estimator import (
    Components,
    Estimator,
    Update,
    nonzero,
    packed_entries,
    pairs,
    places,
)

Pattern = tuple[tuple[int, int], ...]
"""Places of the entries of a matrix that are not 0."""

_Matrix = dict[tuple[int, int], str]
"""Names of the entries of a matrix that are not 0."""


class GeneratedFunction:
    """A function of generated code, which is copied and pickled by what it was generated from.

    Args:
        maker: returns the text of a function `compute`.
        arguments: of the maker, hashable.
    """

    def __init__(self, maker: Callable[..., str], *arguments: Any) -> None:
        self._source = (maker, *arguments)
        self.call = _compiled(maker, arguments)

    def __reduce__(self) -> tuple[Any, ...]:
        return GeneratedFunction, self._source

    def __deepcopy__(self, memo: dict[int, Any]) -> GeneratedFunction:
        return self


@lru_cache(maxsize=256)
def _compiled(maker: Callable[..., str], arguments: tuple[Any, ...]) -> Callable[..., Any]:
    namespace: dict[str, Any] = {}
    exec(compile(maker(*arguments), "<covariance of a filter>", "exec"), namespace)
    return namespace["compute"]


class _Lines:
    """Lines of code, each of which names a number."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def let(self, expression: str) -> str:
        name = f"t{len(self.lines)}"
        self.lines.append(f"    {name} = {expression}")
        return name

    def product(self, one: _Matrix, other: _Matrix, plus: _Matrix | None = None) -> _Matrix:
        """Return one * other (+ plus), of matrices."""
        sums: dict[tuple[int, int], list[str]] = {}
        for (i, k), a in one.items():
            for (row, j), b in other.items():
                if k == row:
                    sums.setdefault((i, j), []).append(f"{a} * {b}")
        for place, c in (plus or {}).items():
            sums.setdefault(place, []).insert(0, c)
        return {place: self._sum(terms) for place, terms in sums.items()}

    def _sum(self, terms: list[str]) -> str:
        return terms[0] if len(terms) == 1 and "*" not in terms[0] else self.let(" + ".join(terms))


def euler_source(n: int, slopes: Pattern, noise: Pattern) -> str:
    """Return code for P <- (I + h A) P (I + h A)' + h Q.

    Args:
        n: number of states.
        slopes: places of the entries of h A, which the function takes after those of P.
        noise: places (i, j), i <= j, of h Q, which it takes last.
    """
    lines, p, a, q = _Lines(), _symmetric(n), _named("a", slopes), _named("q", noise)
    moved = lines.product(a, p, plus=p)
    found = []
    for i, j in pairs(n):
        terms = [moved[i, j]]
        terms += [f"{moved[i, k]} * {entry}" for (row, k), entry in a.items() if row == j]
        terms += [q[i, j]] if (i, j) in q else []
        found.append(" + ".join(terms))
    groups = [("p", len(pairs(n))), ("a", len(slopes)), ("q", len(noise))]
    return _function(lines, groups, found)


def runge_kutta_source(n: int, slopes: Pattern, h: float) -> str:
    """Return code for F - I of a step of Runge and Kutta: (1, 1), (1, 2), ..., (n, n).

    With the slopes A_1..A_4 at the stages: K_1 = A_1, K_2 = A_2 (I + h/2 K_1), K_3 = A_3 (I + h/2
    K_2), K_4 = A_4 (I + h K_3), F = I + h/6 (K_1 + 2 K_2 + 2 K_3 + K_4).

    Args:
        n: number of states.
        slopes: places of the entries of A, which the function takes for each stage.
        h: length of the step in s.
    """
    lines = _Lines()
    stages = [_named(name, slopes) for name in "abcd"]
    derivatives = [stages[0]]
    for stage, length in zip(stages[1:], (h / 2, h / 2, h), strict=True):
        scaled = {at: lines.let(f"{length!r} * {k}") for at, k in derivatives[-1].items()}
        derivatives.append(lines.product(stage, scaled, plus=stage))
    found = []
    for i in range(n):
        for j in range(n):
            terms = [
                f"{factor}{k[i, j]}"
                for k, factor in zip(derivatives, ("", "2.0 * ", "2.0 * ", ""), strict=True)
                if (i, j) in k
            ]
            found.append(f"{h / 6!r} * ({' + '.join(terms)})" if terms else "0.0")
    return _function(lines, [(name, len(slopes)) for name in "abcd"], found)


def update_source(n: int, slopes: tuple[tuple[int, ...], ...], variances: tuple[float, ...]) -> str:
    """Return code for the update by one channel after the other, in Joseph's form.

    All are linearised at the same point, so that their order makes no difference: of channel i the
    innovation is e = nu_i - h_i d, with d the change of the mean so far. With b = P h, s = h' b + r
    and the gain K = b/s, or 0 for a lost sample:

        d <- d + K e,    P <- (I - K h') P (I - K h')' + r K K'

    The function takes the entries of P, those of the gradients h, the innovations nu, and 1.0 or
    0.0 for received and lost samples. It returns d, P, and the sum of e^2/s over what was received.

    Args:
        n: number of states.
        slopes: for each channel the states that it depends on.
        variances: r of each channel.
    """
    lines, p = _Lines(), _symmetric(n)
    change: list[str | None] = [None] * n
    index, squares = 0, []
    for channel, (row, r) in enumerate(zip(slopes, variances, strict=True)):
        h = {j: f"h{index + place}" for place, j in enumerate(row)}
        index += len(row)
        b = [lines.let(" + ".join(f"{p[i, j]} * {c}" for j, c in h.items())) for i in range(n)]
        s = lines.let(" + ".join(f"{c} * {b[j]}" for j, c in h.items()) + f" + {r!r}")
        weight = lines.let(f"g{channel} / {s}")
        e = f"v{channel}" + "".join(f" - {c} * {change[j]}" for j, c in h.items() if change[j])
        e = lines.let(e)
        gain = [lines.let(f"{each} * {weight}") for each in b]
        change = [
            lines.let(f"{gain[i]} * {e}" + (f" + {old}" if old else ""))
            for i, old in enumerate(change)
        ]
        squares.append(f"{e} * {e} * {weight}")
        m = {
            (i, j): lines.let(f"{p[i, j]} - {gain[i]} * {b[j]}")
            for i in range(n)
            for j in range(n)
            if i <= j or j in h
        }
        left = [
            lines.let(
                f"{r!r} * {gain[i]} - " + " - ".join(f"{m[i, j]} * {c}" for j, c in h.items())
            )
            for i in range(n)
        ]
        for i, j in pairs(n):
            p[i, j] = p[j, i] = lines.let(f"{m[i, j]} + {left[i]} * {gain[j]}")
    found = [*(str(d) for d in change), *(p[pair] for pair in pairs(n)), " + ".join(squares)]
    groups = [("p", len(pairs(n))), ("h", index), ("v", len(slopes)), ("g", len(slopes))]
    return _function(lines, groups, found)


def _function(lines: _Lines, groups: Iterable[tuple[str, int]], found: Sequence[str]) -> str:
    arguments = ", ".join(f"{name}{i}" for name, count in groups for i in range(count))
    body = "\n".join(lines.lines)
    return f"def compute({arguments}):\n{body}\n    return ({', '.join(found)},)\n"


def _symmetric(n: int) -> _Matrix:
    return {place: f"p{index}" for place, index in places(n).items()}


def _named(name: str, pattern: Pattern) -> _Matrix:
    return {place: f"{name}{index}" for index, place in enumerate(pattern)}


class ExtendedKalmanFilter(Estimator):
    """The extended Kalman filter (EKF).

    The mean takes the simulator's step without its noise: steps of Euler for a model with noise, of
    Runge and Kutta for one without. The covariance takes the derivative F of that very step,

        P <- F P F' + h sigma sigma',    F = I + h A,    A = d(f + g u)/dx,

    in steps h of Euler; F of a step of Runge and Kutta follows from A at its stages. So mean and
    covariance are those of the simulated process where f, g u and the measurements are affine in x
    and sigma is constant; elsewhere they are approximations, whose honesty the NEES measures.

    Samples are taken in by Joseph's form; see `covariance_source.update_source`.

    Source: Jazwinski, Stochastic Processes and Filtering Theory, 1970, Sec. 8.3; Bucy and Joseph,
        Filtering for Stochastic Processes, 1968.
    """

    name = "ekf"

    def predict(
        self, flavour: Flavour, mean: Components, covariance: Components, u: Components
    ) -> tuple[Components, Components]:
        """Predict; see `Estimator.predict`.

        Args:
            flavour: see there.
            mean: see there.
            covariance: see there.
            u: see there.

        Returns:
            The mean and the covariance.
        """
        if self._noisy:
            return self._euler(flavour, mean, covariance, u)
        return self._runge_kutta(flavour, mean, covariance, u)

    def update(
        self,
        flavour: Flavour,
        mean: Components,
        covariance: Components,
        y: Components,
        received: Components,
    ) -> Update:
        """Take in a sample; see `Estimator.update`.

        Args:
            flavour: see there.
            mean: see there.
            covariance: see there.
            y: see there.
            received: see there.

        Returns:
            The belief after it.
        """
        k = len(y)
        values = self._outputs[flavour](*mean)
        nu = self.innovations(flavour, y, values[:k], received)
        found = self._joseph.call(*covariance, *values[k:], *nu, *[1.0 * has for has in received])
        n = self.n
        moved = [x + d for x, d in zip(mean, found[:n], strict=True)]
        return Update(moved, found[n:-1], nu, found[-1])

    def _euler(
        self, flavour: Flavour, mean: Components, covariance: Components, u: Components
    ) -> tuple[Components, Components]:
        step, n = self._euler_steps[flavour], self.n
        for _ in range(self.substeps):
            values = step(*mean, *u)
            covariance = self._euler_covariance.call(*covariance, *values[n:])
            mean = values[:n]
        return mean, covariance

    def _runge_kutta(
        self, flavour: Flavour, mean: Components, covariance: Components, u: Components
    ) -> tuple[Components, Components]:
        rates, n, h = self._rates[flavour], self.n, self.dt / self.substeps
        noise = [h * a**2 for a in self.added if a]
        for _ in range(self.substeps):
            stages = [rates(*mean, *u)]
            for length in (h / 2, h / 2, h):
                moved = [x + length * k for x, k in zip(mean, stages[-1][:n], strict=True)]
                stages.append(rates(*moved, *u))
            entries = self._transition.call(*[a for stage in stages for a in stage[n:]])
            covariance = self._linear_covariance.call(*covariance, *entries, *noise)
            mean = [
                x + h / 6 * (a + 2.0 * (b + c) + d)
                for x, a, b, c, d in zip(mean, *(stage[:n] for stage in stages), strict=True)
            ]
        return mean, covariance

    @cached_property
    def _noisy(self) -> bool:
        return self.model.noisy  # Which goes through symbols at each call.

    @cached_property
    def _slopes(self) -> tuple[tuple[int, int], ...]:
        return nonzero(self.jacobian)

    @cached_property
    def _euler_steps(self) -> dict[Flavour, Any]:
        model, h = self.model, sp.Float(self.dt / self.substeps, 17)
        moved = sp.Matrix(model.states) + rate(model) * h
        slopes = [self.jacobian[at] * h for at in self._slopes]
        noise = [entry * h for entry in packed_entries(self.diffusion_square)[1]]
        return self._compiled((*model.states, *model.inputs), [*moved, *slopes, *noise])

    @cached_property
    def _rates(self) -> dict[Flavour, Any]:
        model = self.model
        slopes = [self.jacobian[at] for at in self._slopes]
        return self._compiled((*model.states, *model.inputs), [*rate(model), *slopes])

    @cached_property
    def _outputs(self) -> dict[Flavour, Any]:
        rows = [self.output_jacobian[at] for at in nonzero(self.output_jacobian)]
        return self._compiled(self.model.states, [*self._expected, *rows])

    @cached_property
    def _euler_covariance(self) -> GeneratedFunction:
        noise, _ = packed_entries(self.diffusion_square)
        return GeneratedFunction(euler_source, self.n, self._slopes, noise)

    @cached_property
    def _linear_covariance(self) -> GeneratedFunction:
        every = tuple((i, j) for i in range(self.n) for j in range(self.n))
        added = tuple((i, i) for i, a in enumerate(self.added) if a)
        return GeneratedFunction(euler_source, self.n, every, added)

    @cached_property
    def _transition(self) -> GeneratedFunction:
        return GeneratedFunction(runge_kutta_source, self.n, self._slopes, self.dt / self.substeps)

    @cached_property
    def _joseph(self) -> GeneratedFunction:
        places = nonzero(self.output_jacobian)
        rows = tuple(
            tuple(j for i, j in places if i == channel)
            for channel in range(len(self.measurement.channels))
        )
        return GeneratedFunction(update_source, self.n, rows, self.variances)

    def _compiled(self, arguments: Any, expressions: Any) -> dict[Flavour, Any]:
        return {f: compile_function(arguments, expressions, f) for f in ("floats", "arrays")}


class KalmanFilter(ExtendedKalmanFilter):
    """The Kalman filter (KF), of models and measurements that are affine in the state.

    With Gaussian noise and a Gaussian start, mean and covariance are those of the state given the
    measurements, under any inputs that are functions of these.

    Raises:
        ConfigurationError: The model or a measurement is not affine in the state, or the noise or
            the effect of an input depends on it.

    Source: Kalman, A New Approach to Linear Filtering and Prediction Problems, 1960.
    """

    name = "kf"

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        why_not = nonlinearity(self)
        if why_not:
            raise ConfigurationError(
                f"the Kalman filter is of linear systems, and {why_not}; use ekf or ukf"
            )


def nonlinearity(estimator: Estimator) -> str:
    """Return what of an estimator's model and measurements is not affine; "" where all is.

    Args:
        estimator: with the model and what is measured.
    """
    model = estimator.model
    moving = {*model.states, *model.inputs}
    for what, matrix in (
        ("the model", estimator.jacobian),
        ("the noise", estimator.diffusion_square),
        ("the measurement", estimator.output_jacobian),
    ):
        found = sorted(str(s) for e in matrix for s in sp.simplify(e).free_symbols if s in moving)
        if found:
            verb = "depends on" if what == "the noise" else "is not affine in"
            return f"{what} {verb} {found[0]}"
    return ""
