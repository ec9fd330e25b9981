"""A safety problem: plant, model, barriers, input bounds, start, timing and task."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.dynamics.symbols import formula
from safe_envs.errors import ConfigurationError, SystemDefinitionError, require_whole
from safe_envs.problem.actuators import (
    Limits,
    rate_limits,
    require_apart,
    require_delay,
    with_rates,
    with_resting_inputs,
)
from safe_envs.problem.backup import BackupSource, require_backup
from safe_envs.problem.clf import CLF
from safe_envs.problem.frame import Frame
from safe_envs.problem.measurement import Channel, Measurement, measurement_of, require_autonomous
from safe_envs.problem.option_errors import require_bounds, require_period, unknown_start
from safe_envs.problem.options import ProblemOptions, noise_levels
from safe_envs.problem.regions import sound_regions
from safe_envs.problem.signals import TIME, Feature, Variable, bound_pairs, excess
from safe_envs.problem.starts import SamplingDomain, Start


@dataclass(frozen=True)
class Barrier:
    """h, with the safe set C = {x : h(x) >= 0}; a violation is h < 0.

    It is a function of the states, with numbers for its constants: plant and model may differ, what
    is safe is the same for both. A filter in a control loop of the user's takes functions of the
    system's signals and of `safe_envs.problem.signals.TIME` too; in an env, what moves is a state.

    Attributes:
        expression: h(x), or h(x, s, t) with signals s.
        name: how it is called in tables and plots.

    Raises:
        SystemDefinitionError: h is no expression.

    Source: thesis Eq. (3.3), (4.8).
    """

    expression: sp.Expr
    name: str = "h"

    def __post_init__(self) -> None:
        object.__setattr__(self, "expression", formula("a barrier", self.expression))


@dataclass(frozen=True)
class SafetyProblem:
    """What the world is, what the designer believes, what is safe, and what is to be done.

    Attributes:
        name: of the problem.
        plant: the real system, which the env simulates.
        model: what the designer believes; filters and nominal controllers see this one.
        barriers: what is safe.
        states: range and unit of each state of the plant, in order.
        inputs: bounds and unit of each input, in order.
        reward: of a step, an expression of the state that it reaches, of the executed input and of
            `TIME`.
        nominal: the nominal controller, an expression for each input of the features' symbols and
            the model's parameters. The input bounds clip it.
        starts: named initial distributions.
        start: the name of the one in use.
        dt: control period in s.
        horizon: length of an episode in s.
        features: entries of the observation; the states by default.
        goal: the episode ends where this expression is >= 0.
        regions: further sets that specifications name, expressions of the states, >= 0 inside.
        noise: names of the diffusion parameters, in the order of the `noise` argument.
        gains: rates p_1..p_r in 1/s that the conditions use by default, for all
            barriers; or such a tuple for each.
        filter: name of the condition that suits the problem.
        substeps: integration steps in a control period.
        plane: the two states that draw a trajectory, if any.
        scene: how the problem is drawn, a name of `safe_envs.rendering.scenes`; "" for the drawing
            that fits every problem.
        clf: the task as a soft goal, if it is one.
        sampling: where and how the system is excited to learn from it, as far as the defaults do
            not suit; see `sampling_domain`.
        frame: coordinates in which the problem closes, if it has a symmetry; see `Frame`.
        delay: control periods after which the plant executes an input that is sent. Before the
            first arrives, it executes the one within the input bounds nearest to 0.
        model_delay: the delay that filters believe; that of the plant by default.
        slew_limit: bounds of the rates of the plant's actuators, see `ProblemOptions`; () without.
        rates: bounds of the rates of inputs that have become states, see
            `safe_envs.problem.actuators`; () without.
        backup: laws that bring the system to a set that is safe for good, if any; see `Backup`.
        sensors: channels of a realistic sensor; () for one derived from the features.
        measurement: what is measured of the state, which is the observation then; None for an
            observation of the features without any error.

    Raises:
        SystemDefinitionError: the parts do not fit together.
    """

    name: str
    plant: ControlAffineSDE
    model: ControlAffineSDE
    barriers: tuple[Barrier, ...]
    states: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    reward: sp.Expr
    nominal: tuple[sp.Expr, ...]
    starts: Mapping[str, Start]
    dt: float
    horizon: float
    features: tuple[Feature, ...] = ()
    start: str = ""
    goal: sp.Expr | None = None
    regions: Mapping[str, sp.Expr] = field(default_factory=dict)
    noise: tuple[str, ...] = ()
    gains: tuple[float, ...] | tuple[tuple[float, ...], ...] = (1.0,)
    filter: str = "hocbf"
    substeps: int = 1
    plane: tuple[str, str] | None = None
    scene: str = ""
    clf: CLF | None = None
    sampling: SamplingDomain = field(default_factory=SamplingDomain)
    frame: Frame | None = None
    delay: int = 0
    model_delay: int | None = None
    slew_limit: Limits = ()
    rates: Limits = ()
    backup: BackupSource | None = None
    sensors: tuple[Channel, ...] = ()
    measurement: Measurement | None = None
    input_bounds: tuple[tuple[float, float], ...] = field(init=False)

    def __repr__(self) -> str:
        barriers = ", ".join(barrier.name for barrier in self.barriers)
        return (
            f"SafetyProblem({self.name}, n={len(self.states)}, m={len(self.inputs)},"
            f" barriers=[{barriers}], dt={self.dt:g}, horizon={self.duration:g})"
        )

    def __post_init__(self) -> None:
        plant, model = self.plant, self.model
        if not self.features:
            features = tuple(Feature(s.symbol.name, s.symbol, s.low, s.high) for s in self.states)
            object.__setattr__(self, "features", features)
        object.__setattr__(self, "start", self.start or next(iter(self.starts)))
        object.__setattr__(self, "input_bounds", tuple((i.low, i.high) for i in self.inputs))
        for which, system in (("plant", plant), ("model", model)):
            require_autonomous(which, system)
        if (plant.states, plant.inputs) != (model.states, model.inputs):
            raise SystemDefinitionError("plant and model must have the same states and inputs")
        if (
            tuple(s.symbol for s in self.states) != plant.states
            or tuple(i.symbol for i in self.inputs) != plant.inputs
        ):
            raise SystemDefinitionError(
                "the ranges of states and inputs must be given in the order of the plant's symbols"
            )
        if not self.barriers or len(self.nominal) != plant.m:
            raise SystemDefinitionError(
                f"a problem needs a barrier and a nominal expression for each of the {plant.m}"
                " inputs"
            )
        for barrier in self.barriers:
            plant.require_known(
                f"barrier {barrier.name}", barrier.expression.free_symbols, plant.states
            )
        if isinstance(self.gains[0], tuple) and len(self.gains) != len(self.barriers):
            raise SystemDefinitionError(
                f"gains has {len(self.gains)} tuples for {len(self.barriers)} barriers; give one"
                " for each"
            )
        plant.require_known(
            "the reward", self.reward.free_symbols, (*plant.states, *plant.inputs, TIME)
        )
        for feature in self.features:
            plant.require_known(
                f"feature {feature.name}", feature.expression.free_symbols, (*plant.states, TIME)
            )
        self._check_feature_names()
        for law in self.nominal:
            known = (*(f.symbol for f in self.features), *model.parameters)
            plant.require_known("the nominal controller", law.free_symbols, known)
        object.__setattr__(self, "regions", sound_regions(self.regions, plant))
        if self.clf is not None:
            self.clf.require_known(model, model.states)
        if self.frame is not None:
            self.frame.require_known(plant)
        require_backup(self.backup, plant)
        if self.sensors:
            Measurement(self.sensors).require_known(plant)
        if self.measurement is not None:
            self.measurement.require_known(plant)
        for i in self.inputs:
            require_bounds(i.symbol.name, i.low, i.high)
        self._check_timing()
        for coordinate in self.sampling.coordinates:
            plant.require_known(
                "a coordinate of the sampling domain", coordinate.free_symbols, plant.states
            )

    @cached_property
    def sampling_domain(self) -> SamplingDomain:
        """Where and how the system is excited to learn from it, complete.

        Raises:
            SystemDefinitionError: a state without a finite range has none in `sampling` either.
        """
        return self.sampling.completed(self.states, self.input_bounds)

    def _check_feature_names(self) -> None:
        """Check that a symbol of the nominal controller means one thing."""
        symbols = [f.symbol for f in self.features]
        twice = {s.name for s in symbols if symbols.count(s) > 1 or s in self.model.parameters}
        if twice:
            raise SystemDefinitionError(
                f"features named twice, or like a parameter: {', '.join(sorted(twice))}; give each"
                " another name"
            )

    def _check_timing(self) -> None:
        require_period(self.dt)
        if not math.isfinite(self.horizon / self.dt) or round(self.horizon / self.dt) < 1:
            raise ConfigurationError(
                f"horizon = {self.horizon} s; it must hold at least one control period of"
                f" {self.dt} s"
            )
        require_whole("substeps", self.substeps, 1)
        require_delay("delay", self.delay)
        if self.model_delay is not None:
            require_delay("model_delay", self.model_delay)

    def gains_of(self, barrier: int) -> tuple[float, ...]:
        """Return the rates p_1..p_r of a barrier, given by its index."""
        gains: Any = self.gains
        return gains[barrier] if isinstance(gains[0], tuple) else gains

    @property
    def steps(self) -> int:
        """Control periods in an episode."""
        return round(self.horizon / self.dt)

    @property
    def duration(self) -> float:
        """Length of an episode in s as it is simulated, in whole control periods."""
        return self.steps * self.dt

    @property
    def believed_delay(self) -> int:
        """The delay of the inputs that filters believe, in control periods."""
        return self.delay if self.model_delay is None else self.model_delay

    @property
    def direct(self) -> bool:
        """Whether inputs are executed, and believed to be, as and when they are sent."""
        return not (self.delay or self.believed_delay or self.slew_limit)

    @property
    def unmeasured(self) -> SafetyProblem:
        """The problem without a sensor, whose observation is of the true state."""
        return self if self.measurement is None else replace(self, measurement=None)

    @property
    def actuators(self) -> str:
        """What lies between the sent and the executed input, in words of the options."""
        slew = "".join(f", slew_limit {low:g},{high:g}" for low, high in self.slew_limit)
        return f"delay {self.delay}, model_delay {self.believed_delay}{slew}"

    @property
    def outside(self) -> sp.Expr:
        """Positive where the state has left the workspace; -1 if the workspace is unbounded."""
        return excess(self.states)

    def configured(self, **options: Any) -> SafetyProblem:
        """Return the problem with other numbers; what is not given stays.

        Args:
            **options: fields of `ProblemOptions`, except `barrier`, whose arguments go to the
                function that builds the problem.

        Raises:
            ConfigurationError: A name is unknown or a value is not allowed.
        """
        given = ProblemOptions.of(self.name, options, ())
        levels = noise_levels(self, given.noise)
        if self.rates:
            require_apart(given, self)
        changes: dict[str, Any] = {
            "plant": self.plant.with_parameters(**{**levels, **(given.plant or {})}),
            "model": self.model.with_parameters(**{**levels, **(given.model or {})}),
        }
        for name in ("dt", "substeps", "horizon", "delay", "model_delay"):
            if getattr(given, name) is not None:
                changes[name] = getattr(given, name)
        if given.input_bounds is not None:
            pairs = bound_pairs(given.input_bounds, len(self.inputs))
            changes["inputs"] = tuple(
                replace(i, low=low, high=high)
                for i, (low, high) in zip(self.inputs, pairs, strict=True)
            )
        if given.slew_limit is not None:
            changes["slew_limit"] = rate_limits("slew_limit", given.slew_limit, len(self.inputs))
        if given.rate_limit is not None:
            limits = rate_limits("rate_limit", given.rate_limit, len(self.inputs))
            free = replace(self, **changes)
            rest = {"measurement": given.measurement, "sensor_noise": given.sensor_noise}
            start = with_resting_inputs(given.start, free)
            return replace(free, **with_rates(free, limits)).configured(start=start, **rest)
        if given.measurement is not None or given.sensor_noise is not None:
            changes["measurement"] = measurement_of(self, given.measurement, given.sensor_noise)
        start = given.start
        if isinstance(start, str):
            if start not in self.starts:
                raise unknown_start(start, self.starts, len(self.states))
            changes["start"] = start
        elif start is not None:
            changes["starts"] = {**self.starts, "given": Start.given(self.states, start)}
            changes["start"] = "given"
        return replace(self, **changes)
