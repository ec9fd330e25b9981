"""How a filter sees a third-party env: a model of it, what is safe, where state and input are."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, InvalidInputError, nearest, unexpected_argument
from safe_envs.filters.conditions.class_k import entries_of
from safe_envs.plugins import load_object
from safe_envs.problem.builder import law_of, named_barriers, suitable
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.problem.starts import Start
from safe_envs.problem.validation import degree_of
from safe_envs.text import finite_number

Map = Callable[[np.ndarray], np.ndarray]

_POINTS = 64
"""At which an action map is tried."""


class ActionMap(NamedTuple):
    """Between an env's actions and the model's inputs, both of shape (..., m).

    Attributes:
        to_input: from actions to inputs.
        to_action: back.
    """

    to_input: Map
    to_action: Map

    @classmethod
    def scaled(cls, factor: Any, offset: Any = 0.0) -> ActionMap:
        """Return the map of input = offset + factor action.

        Args:
            factor: a number, or one for each input.
            offset: likewise.

        Raises:
            ConfigurationError: A number is not finite, or a factor is 0.
        """
        f, o = np.asarray(factor, dtype=float), np.asarray(offset, dtype=float)
        if not (np.isfinite(f).all() and np.isfinite(o).all() and f.all()):
            raise ConfigurationError(
                f"factor = {factor!r} and offset = {offset!r} of an action map; give finite"
                " numbers, and no factor 0"
            )
        return cls(partial(_scaled, f, o), partial(_unscaled, f, o))


def _scaled(factor: np.ndarray, offset: np.ndarray, action: np.ndarray) -> np.ndarray:
    return offset + factor * action


def _unscaled(factor: np.ndarray, offset: np.ndarray, u: np.ndarray) -> np.ndarray:
    return (u - offset) / factor


@dataclass(frozen=True)
class FilterSpec:
    """What a filter needs to know of a third-party env.

    Attributes:
        model: of the env, continuous in time; nobody checks that the env obeys it.
        barriers: h, safe where h >= 0: an expression of the model's states or a `Barrier`, or
            several of them.
        state_fn: from the observation that the wrapper gets, (..., k) mostly, to states (..., n),
            over any leading axes: write `observation[..., 0]`.
        action_map: between the env's actions and the model's inputs; None where they are the same.
        filter: text of the filter where an evaluation names none, like "hocbf:alpha=2,8"; None for
            what suits the model.
        dt: control period in s; None for the env's own attribute `dt`.
        gains: rates of conditions whose text sets none; ones by default. See
            `SafetyProblem`.
        nominal: a controller to be kept safe, an expression of the model's states and parameters
            for each input; if any.
        backup: laws for the filter "backup", see `safe_envs.problem.backup.Backup`; if any.

    Raises:
        RelativeDegreeError: no input reaches a barrier.
        SystemDefinitionError: a barrier or a law has unknown symbols.
        ConfigurationError: a part is of the wrong kind.
    """

    model: ControlAffineSDE
    barriers: Any
    state_fn: Map
    action_map: ActionMap | None = None
    filter: str | None = None
    dt: float | None = None
    gains: tuple[Any, ...] | None = None
    nominal: Any = None
    backup: Any = None

    def __post_init__(self) -> None:
        if not isinstance(self.model, ControlAffineSDE):
            raise ConfigurationError(
                f"model is {type(self.model).__name__}; give a ControlAffineSDE"
            )
        if not callable(self.state_fn):
            raise ConfigurationError(
                f"state_fn = {self.state_fn!r}; give a function of observations (..., k) that"
                " returns states"
            )
        pair = self.action_map
        if pair is not None and not (
            isinstance(pair, tuple) and len(pair) == 2 and all(map(callable, pair))
        ):
            raise ConfigurationError(
                f"action_map = {pair!r}; give ActionMap(to_input, to_action), or"
                " ActionMap.scaled(factor)"
            )
        for barrier in self.named:
            degree_of(self.model, barrier.expression)

    @classmethod
    def refuse_unknown(cls, names: Iterable[str]) -> None:
        """Raise UnknownArgumentError for a name that no wrapper takes."""
        allowed = [f.name for f in fields(cls) if f.name != "filter"]
        for name in names:
            if name not in allowed:
                raise unexpected_argument("the filter", name, nearest(name, allowed))

    @classmethod
    def of(cls, view: dict[str, Any]) -> FilterSpec:
        """Return a spec from arguments by name.

        Raises:
            ConfigurationError: one that is needed is missing.
        """
        missing = [name for name in ("model", "barriers", "state_fn") if name not in view]
        if missing:
            raise ConfigurationError(
                f"a filter over an env that is not this project's needs {', '.join(missing)} too"
            )
        return cls(**view)

    @classmethod
    def load(cls, place: str) -> FilterSpec:
        """Import a spec from FILE.py:NAME or MODULE:NAME, which runs the code there.

        Raises:
            ConfigurationError: there is none.
        """
        found = load_object(place)
        if not isinstance(found, cls):
            raise ConfigurationError(f"{place} is {type(found).__name__}; give a FilterSpec")
        return found

    @property
    def named(self) -> tuple[Barrier, ...]:
        """The barriers, each with a name."""
        return named_barriers(self.barriers)

    def state(self, observation: Any, batch: tuple[int, ...] = ()) -> np.ndarray:
        """Return the state (n,) that an observation shows, or the states (B, n) of a batch.

        Args:
            observation: of an env, or of a batch of them.
            batch: its size (B,), if it is one.

        Raises:
            InvalidInputError: `state_fn` fails, or returns another shape or no finite numbers.
        """
        shape = (*batch, self.model.n)
        try:
            x = np.array(self.state_fn(observation), dtype=np.float64)
        except Exception as error:
            raise InvalidInputError(
                f"state_fn failed at an observation: {type(error).__name__}: {error}"
            ) from error
        if x.shape != shape:
            raise InvalidInputError(
                f"state_fn made {x.shape} of observations {np.shape(observation)}; the model needs"
                f" {shape}. Write it for any leading axes, like np.stack([observation[..., 0],"
                " observation[..., 1]], axis=-1)"
            )
        if not np.isfinite(x).all():
            raise InvalidInputError(
                f"state_fn made {x.tolist()} of {observation!r}; a filter needs finite numbers"
            )
        return x

    def inputs(self, actions: np.ndarray) -> np.ndarray:
        """Return the model's inputs (..., m) for the env's actions."""
        found = actions if self.action_map is None else self.action_map.to_input(actions)
        return np.asarray(found, dtype=np.float64)

    def actions(self, inputs: np.ndarray) -> np.ndarray:
        """Return the env's actions (..., m) for the model's inputs."""
        found = inputs if self.action_map is None else self.action_map.to_action(inputs)
        return np.asarray(found, dtype=np.float64)

    def problem(
        self, env: Any, action_space: gym.Space[Any], name: str, steps: int | None
    ) -> SafetyProblem:
        """Return the model as a problem of its own, for conditions, the filter and evaluations.

        Args:
            env: where the attribute `dt` may be found.
            action_space: of one env.
            name: of the env.
            steps: after which an episode is truncated, if it is.

        Raises:
            ConfigurationError: the action space is no finite box of as many numbers as the model
                has inputs, the action map does not take it to a box and back, or the control period
                is unknown.
        """
        period, (low, high) = self._period(env, name), self._bounds(action_space, name)
        defaults = suitable(self.model, self.named)
        model, still = self.model, sp.Integer(0)
        laws = (still,) * model.m if self.nominal is None else entries_of(self.nominal)
        return SafetyProblem(
            name=name,
            plant=model,
            model=model,
            barriers=self.named,
            states=tuple(Variable(s, -math.inf, math.inf) for s in model.states),
            inputs=tuple(map(Variable, model.inputs, low.tolist(), high.tolist())),
            reward=still,
            nominal=tuple(law_of(law, model) for law in laws),
            starts={"of the env": Start.at((0.0,) * model.n)},
            dt=period,
            horizon=(steps or 1) * period,
            backup=self.backup,
            **{**defaults, **({} if self.gains is None else {"gains": self.gains})},
        )

    def _period(self, env: Any, name: str) -> float:
        given = getattr(env, "dt", None) if self.dt is None else self.dt
        if given is None:
            raise ConfigurationError(
                f"{name} has no attribute dt, so that its control period is unknown; give dt, in s"
            )
        return finite_number("dt", given)

    def _bounds(self, space: gym.Space[Any], name: str) -> tuple[np.ndarray, np.ndarray]:
        m = self.model.m
        if (
            not isinstance(space, gym.spaces.Box)
            or space.shape != (m,)
            or not space.is_bounded()
            or space.dtype.kind != "f"
        ):
            raise ConfigurationError(
                f"the action space of {name} is {space}; a filter of {m} inputs needs a bounded Box"
                f" of floats of ({m},)"
            )
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        ends = self._mapped(np.stack([low, high]))
        least, most = ends.min(axis=0), ends.max(axis=0)
        rng = np.random.default_rng(0)
        actions = rng.uniform(low, high, (_POINTS, m))
        there, back = self._mapped(actions), self.actions(rng.uniform(least, most, (_POINTS, m)))
        fits = all(
            (found >= lo - 1e-6 * (hi - lo)).all() and (found <= hi + 1e-6 * (hi - lo)).all()
            for found, lo, hi in ((there, least, most), (back, low, high))
        ) and np.allclose((self.actions(there) - actions) / (high - low), 0.0, atol=1e-6)
        if not fits or (least == most).any():
            raise ConfigurationError(
                f"the action map does not take the action space {space} to a box of inputs and"
                " back: to_action is to undo to_input, and each action is to move one input alone"
            )
        return least, most

    def _mapped(self, actions: np.ndarray) -> np.ndarray:
        found = self.inputs(actions)
        if found.shape != actions.shape:
            raise ConfigurationError(
                f"to_input of the action map made {found.shape} of actions {actions.shape}; it is"
                " to keep the shape"
            )
        return found
