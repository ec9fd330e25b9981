"""What lies between the input that is sent and the one that the plant executes.

With x the states and u the inputs of a problem, and bounds r- < 0 < r+ of du/dt, the problem of
limited rate has the states (x, u) and the inputs v with v in [r-, r+]:

    dx = (f(x) + g(x) u) dt + sigma(x) dW,    du = (a(u) + b(u) v) dt

All else follows from that statement by itself: constraints, whose relative degree is one higher,
filters, simulation, compiled programs, tables and proofs.

**The inputs stay within their bounds.** Of the rates [r-, r+] those are left that carry u across no
bound [u-, u+] within a control period dt, from

    l(u) = max(r-, (u- - u)/dt)    to    k(u) = min(r+, (u+ - u)/dt),

and a, b map [r-, r+] onto [l, k]: b = (k - l)/(r+ - r-), a = l - b r-. So du/dt = v, unless u is
closer to a bound than the largest rate goes in one period. Under a constant v the rate F = a + b v
is an average of l and k, which falls with u, nowhere by more than 1/dt, from F(u-) >= 0 to
F(u+) <= 0. So it has a zero u* between the bounds, and is at most |u* - u|/dt, towards u*. Hence
each stage of a step of Euler or of Runge and Kutta no longer than dt, and the result of the step,
lies between u and u*, and within the bounds. In one step of Euler (noise, no sub-steps) u becomes
u + dt F in [u-, u+], any value that the rates [r-, r+] reach. The range of the states u is wider
than the bounds by a millionth, so that rounding ends no episode.

What differs from an actuator that slews towards a command u_c, u[k+1] = clip(u_c, u[k] + dt r-,
u[k] + dt r+), which the option `slew_limit` simulates: the inputs at control instants can be the
same, but what is decided is the rate in place of the command, and it is the input at the end of a
period that it decides. There the input of the period itself is decided, and constant in it. Here
the input is a ramp; in a step of Euler it is that of the start of the period, so that a decision
acts one period later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.arrays import numbers_in
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, SystemDefinitionError, require_whole, shown
from safe_envs.problem.frame import Frame
from safe_envs.problem.measurement import Channel
from safe_envs.problem.option_errors import LONGEST_DELAY
from safe_envs.problem.options import ProblemOptions
from safe_envs.problem.signals import Feature, Variable, bound_pairs
from safe_envs.problem.starts import SamplingDomain, Start

Limits = tuple[tuple[float, float], ...]
"""(low, high) of the rate of each input, in its unit per second."""


def require_delay(name: str, delay: Any) -> None:
    """Raise ConfigurationError unless a delay is a whole number of control periods.

    Args:
        name: of the argument.
        delay: that was given.
    """
    require_whole(name, delay, 0)
    if delay > LONGEST_DELAY:
        raise ConfigurationError(
            f"{name} = {delay}; it counts control periods, {LONGEST_DELAY} at most"
        )


def rate_limits(name: str, given: Any, count: int) -> Limits:
    """Return the bounds of the rate of each input.

    Args:
        name: of the argument, for errors.
        given: (low, high) for all inputs, or one such pair for each, in the input's unit per s.
        count: number of inputs.

    Raises:
        ConfigurationError: They are neither, or not low < 0 < high: then an input could not be
            held, and not be kept within its bounds.
    """
    pairs = numbers_in(given)
    pairs = np.broadcast_to(pairs, (count, 2)) if pairs.shape == (2,) else pairs
    found = tuple((float(low), float(high)) for low, high in pairs) if pairs.ndim == 2 else ()
    if pairs.shape != (count, 2) or not all(
        -1e100 <= low < 0.0 < high <= 1e100 for low, high in found
    ):
        raise ConfigurationError(
            f"{name} = {shown(given)}; give (low, high) with low < 0 < high in the input's unit per"
            f" second, or one such pair for each of the {count} inputs"
        )
    return found


def resting_input(input_bounds: Sequence[tuple[float, float]]) -> list[float]:
    """Return the input that is executed before any arrives: within its bounds, nearest to 0.

    Args:
        input_bounds: (low, high) of each input.
    """
    return [min(max(0.0, low), high) for low, high in input_bounds]


def why_not_direct(problem: Any, what: str) -> str:
    """Return why something that takes inputs to be executed when they are sent cannot be had.

    Args:
        problem: a `SafetyProblem`.
        what: what is asked for, a plural.

    Returns:
        "" for a problem without a delay or a slew limit, in the plant or as filters believe it.
    """
    if problem.direct:
        return ""
    return (
        f"{what} are not for a delay or a slew limit: {problem.name} has {problem.actuators}; they"
        " are about inputs that are executed as and when they are sent. Leave delay, model_delay"
        " and slew_limit out; rate_limit states limited rates as part of the system"
    )


def require_direct(problem: Any, what: str) -> None:
    """Raise ConfigurationError where there is a reason; see `why_not_direct`.

    Args:
        problem: see there.
        what: see there.
    """
    reason = why_not_direct(problem, what)
    if reason:
        raise ConfigurationError(reason)


_ROUNDING = 1e-6
"""Part of the width of an input's bounds by which its range as a state is wider."""

_INPUT_NOISE = 1e-3
"""Standard deviation of a sensor of an input, as a part of the width of its bounds."""

_DEGREE_FREE = ("hocbf", "szcbf")
"""Default filters for every relative degree, which stay."""


def with_rates(problem: Any, limits: Limits) -> dict[str, Any]:
    """Return the attributes of a problem that limited rates of its inputs change.

    - Starts put the inputs at rest: within their bounds, nearest to 0.
    - The observation gets the inputs, by their names.
    - The nominal controller asks for the rate that brings its own input about in one period.
    - Every barrier gets one more gain, 1/dt: then the constraint on the rate asks, to first order,
      that the input after this period meets the former constraint there. A default filter for
      relative degree 1 gives way to "szcbf" with noise, "hocbf" without.
    - The reward, an expression of the executed input, takes the one that a period ends with.
    - The goal of the joint QP is left out: of its V, one derivative does not hold the rate.
    - The backup is left out: its laws give the input, not the rate.
    - A sensor that the problem states gets the inputs, with a standard deviation of a thousandth of
      the width of their bounds. What was measured of the problem without limits stays as it is.

    Args:
        problem: a `SafetyProblem` without limits.
        limits: of the rate of each input.

    Returns:
        Attributes by name, for `dataclasses.replace`.

    Raises:
        SystemDefinitionError: a feature or a symbol has the name that an input or its rate is to
            have.
    """
    wider = [(v, _ROUNDING * (v.high - v.low)) for v in problem.inputs]
    ranges = tuple(replace(v, low=v.low - more, high=v.high + more) for v, more in wider)
    rates = tuple(_rate_of(v, ends) for v, ends in zip(problem.inputs, limits, strict=True))
    _require_free_names(problem, rates)
    maps = [_map(v, ends, problem.dt) for v, ends in zip(problem.inputs, limits, strict=True)]
    sensors = [
        Channel(v.symbol.name, v.symbol, _INPUT_NOISE * (v.high - v.low)) for v in problem.inputs
    ]
    rest = tuple(sp.Float(u, 17) for u in resting_input(problem.input_bounds))
    seen = tuple(Feature(v.symbol.name, v.symbol, v.low, v.high) for v in problem.inputs)
    laws = zip(problem.nominal, problem.inputs, limits, seen, strict=True)
    suitable = "szcbf" if problem.model.noisy else "hocbf"
    return {
        "plant": _with_input_states(problem.plant, rates, maps),
        "model": _with_input_states(problem.model, rates, maps),
        "states": (*problem.states, *ranges),
        "inputs": rates,
        "features": (*problem.features, *seen),
        "nominal": tuple(_law(law, v, ends, f.symbol, problem.dt) for law, v, ends, f in laws),
        "starts": {
            name: Start((*start.state, *rest), start.uniforms, start.condition)
            for name, start in problem.starts.items()
        },
        "gains": _extended(problem.gains, 1.0 / problem.dt),
        "filter": problem.filter if problem.filter in _DEGREE_FREE else suitable,
        "clf": None,
        "backup": None,
        "sensors": problem.sensors and (*problem.sensors, *sensors),
        "sampling": _sampling(problem.sampling, ranges),
        "frame": _framed(problem.frame, problem.inputs),
        "rates": limits,
    }


def with_resting_inputs(start: Any, problem: Any) -> Any:
    """Return a start with the inputs at rest, where it has a number for each other state only.

    Args:
        start: a name, numbers, or None.
        problem: a `SafetyProblem` without limits.
    """
    if start is None or isinstance(start, str) or numbers_in(start).shape != (len(problem.states),):
        return start
    return [*numbers_in(start).tolist(), *resting_input(problem.input_bounds)]


def input_ranges(problem: Any) -> dict[sp.Symbol, tuple[float, float]]:
    """Return the bounds of the inputs that are states; their ranges as states are wider.

    Args:
        problem: a `SafetyProblem`.
    """
    count = len(problem.rates)
    return {f.symbol: (f.low, f.high) for f in problem.features[len(problem.features) - count :]}


def require_apart(given: ProblemOptions, problem: Any) -> None:
    """Check that options leave alone what the rates of a problem's inputs have been derived from.

    Args:
        given: options for the problem.
        problem: a `SafetyProblem` whose inputs have limited rates.

    Raises:
        ConfigurationError: They do not.
    """
    boxes = (None, list(problem.input_bounds))
    input_bounds = (
        None if given.input_bounds is None else bound_pairs(given.input_bounds, len(problem.inputs))
    )
    changed = ["dt"] * (given.dt not in (None, problem.dt)) + ["input_bounds"] * (
        input_bounds not in boxes
    )
    changed += ["rate_limit"] * (given.rate_limit is not None)
    if changed:
        raise ConfigurationError(
            f"{', '.join(changed)}: the inputs of this problem have limited rates, which were"
            " derived with its own dt and input_bounds; give dt, input_bounds and rate_limit"
            " together, to the problem without limits"
        )


def _rate_of(v: Variable, ends: tuple[float, float]) -> Variable:
    unit = f"{v.unit}/s" if v.unit else "1/s"
    return Variable(sp.Symbol(f"{v.symbol.name}_rate", real=True), *ends, unit)


def _require_free_names(problem: Any, rates: Sequence[Variable]) -> None:
    system = problem.plant
    taken = {s.name for s in (*system.states, *system.inputs, *system.parameters)}
    clashes = [v.symbol.name for v in rates if v.symbol.name in taken]
    clashes += [f.name for f in problem.features for v in problem.inputs if f.name == v.symbol.name]
    if clashes:
        raise SystemDefinitionError(
            f"{', '.join(clashes)}: with limited rates, an input is a feature of its own name and"
            " its rate is called NAME_rate; rename what has that name now"
        )


def _allowed(
    u: sp.Expr, v: Variable, ends: tuple[float, float], dt: float
) -> tuple[sp.Expr, sp.Expr]:
    """Return the rates l(u) and k(u) between which u crosses no bound within a period."""
    low, high, period = (sp.Float(number, 17) for number in (v.low, v.high, dt))
    return sp.Max(ends[0], (low - u) / period), sp.Min(ends[1], (high - u) / period)


def _map(v: Variable, ends: tuple[float, float], dt: float) -> tuple[sp.Expr, sp.Expr]:
    """Return a(u) and b(u)."""
    least, most = _allowed(v.symbol, v, ends, dt)
    effect = (most - least) / sp.Float(ends[1] - ends[0], 17)
    return least - effect * sp.Float(ends[0], 17), effect


def _with_input_states(
    system: ControlAffineSDE,
    rates: Sequence[Variable],
    maps: Sequence[tuple[sp.Expr, sp.Expr]],
) -> ControlAffineSDE:
    m = system.m
    moved = sp.Matrix(system.drift) + sp.Matrix(system.input_matrix) * sp.Matrix(system.inputs)
    diffusion = sp.Matrix(system.diffusion)
    return ControlAffineSDE(
        states=(*system.states, *system.inputs),
        inputs=tuple(v.symbol for v in rates),
        drift=moved.col_join(sp.Matrix([a for a, _ in maps])),
        input_matrix=sp.zeros(system.n, m).col_join(sp.diag(*[b for _, b in maps])),
        diffusion=diffusion.col_join(sp.zeros(m, diffusion.cols)),
        parameters=system.parameters,
    )


def _law(law: sp.Expr, v: Variable, ends: tuple[float, float], u: sp.Symbol, dt: float) -> sp.Expr:
    """Return the v whose rate brings the input of a law about in one period, as far as it can."""
    least, most = _allowed(u, v, ends, dt)
    wanted = sp.Min(sp.Max((law - u) / sp.Float(dt, 17), least), most)
    return ends[0] + (wanted - least) * sp.Float(ends[1] - ends[0], 17) / (most - least)


def _extended(gains: Any, last: float) -> Any:
    if isinstance(gains[0], tuple):
        return tuple((*each, last) for each in gains)
    return (*gains, last)


def _sampling(sampling: SamplingDomain, ranges: Sequence[Variable]) -> SamplingDomain:
    region = (*sampling.region, *((v.low, v.high) for v in ranges)) if sampling.region else ()
    inputs = tuple(v.symbol for v in ranges)
    return SamplingDomain(region, (), (*sampling.coordinates, *inputs) * bool(sampling.coordinates))


def _framed(frame: Frame | None, inputs: Sequence[Variable]) -> Frame | None:
    """Return a frame in which the inputs stand for themselves."""
    if frame is None:
        return None
    return replace(frame, section=(*frame.section, *(v.symbol for v in inputs)))
