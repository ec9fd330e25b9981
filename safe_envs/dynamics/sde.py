"""A control-affine stochastic differential equation, defined once, in symbols."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NoReturn, TypeVar

import sympy as sp

from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.symbols import (
    TIME,
    advice_on_unknown,
    doubt_shared_noise,
    fitting,
    read_matrix,
    require_mappings,
    require_real,
    signal_rate,
)
from safe_envs.errors import ConfigurationError, SystemDefinitionError, unknown

K = TypeVar("K")
V = TypeVar("V")


class FixedDict(dict[K, V]):
    """A dict whose entries stay as they are: for what is hashed, or compiled into formulas.

    It is equal to a dict with these entries, and can be pickled and copied.
    """

    def _refuse(self, *given: Any, **named: Any) -> NoReturn:
        raise TypeError(f"{dict(self)} does not change; make another system, of a changed copy")

    __setitem__ = __delitem__ = __ior__ = _refuse  # pyright: ignore
    update = setdefault = pop = popitem = clear = _refuse  # pyright: ignore

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (dict(self),)

    def __copy__(self) -> FixedDict[K, V]:
        return self


@dataclass(frozen=True)
class ControlAffineSDE:
    """dx = (f + g u) dt + sigma dW, with f, g and sigma of the states x, signals s and the time t.

    Exogenous motion, a moving obstacle say, is a state of its own with a known drift, so that no
    time derivative of a barrier can be forgotten. In a control loop that measures it, it is a
    signal: its values come in at run time, and its rate ds/dt enters every derivative along the
    system as a drift would. Signals carry no noise. The time is
    `safe_envs.problem.signals.TIME`. Envs simulate what moves: there it is a state.

    States and inputs are symbols that are declared real and nothing more, parameters real or
    whatever else their values are, signals real or of one sign: sympy simplifies by these words,
    sqrt(x**2) to |x| for a real x, to x for a positive one, and not at all without.

    Attributes:
        states: n symbols x.
        inputs: m symbols u.
        drift: f, n x 1 expressions of states, signals, parameters and the time. Lists are read as
            matrices, here and below.
        input_matrix: g, n x m.
        diffusion: sigma, n x d, for a d-dimensional standard Wiener process W; none by default. A
            flat list is one column: a single Wiener process.
        parameters: value of every other symbol that occurs.
        signals: the rate of each quantity that is measured at run time, an expression like those of
            the drift; 0 for one that does not change by itself, such as a mass.

    Raises:
        SystemDefinitionError: a shape does not fit, a symbol is unknown, defined twice or not
            declared real, or an input occurs in f, g, sigma or the rate of a signal, so that the
            system is not control-affine.
        ConfigurationError: a parameter is no finite number, or not what its symbol is declared to
            be.

    Source: thesis Eq. (4.1).
    """

    states: tuple[sp.Symbol, ...]
    inputs: tuple[sp.Symbol, ...]
    drift: Any
    input_matrix: Any
    diffusion: Any = None
    parameters: Mapping[sp.Symbol, float] = field(default_factory=dict)
    signals: Mapping[sp.Symbol, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_mappings(self.parameters, self.signals)
        require_real(self.states, self.inputs, self.parameters, self.signals)
        n, m = len(self.states), len(self.inputs)
        if not n or not m:
            raise SystemDefinitionError(
                f"a system needs a state and an input; given {n} states and {m} inputs"
            )
        noise = [[0]] * n if self.diffusion is None else self.diffusion
        doubt_shared_noise(noise)
        fields: dict[str, Any] = {
            "states": tuple(self.states),
            "inputs": tuple(self.inputs),
            "drift": read_matrix("drift", self.drift, (n, 1)),
            "input_matrix": read_matrix("input_matrix", self.input_matrix, (n, m)),
            "diffusion": read_matrix("diffusion", noise, (n, None)),
            "parameters": FixedDict({p: fitting(p, v) for p, v in self.parameters.items()}),
            "signals": FixedDict({s: signal_rate(s, r) for s, r in self.signals.items()}),
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        self._check_symbols()

    @classmethod
    def from_rate(
        cls,
        states: Sequence[sp.Symbol],
        inputs: Sequence[sp.Symbol],
        rate: Sequence[Any],
        diffusion: Any = None,
        parameters: Mapping[sp.Symbol, float] | None = None,
        signals: Mapping[sp.Symbol, Any] | None = None,
    ) -> ControlAffineSDE:
        """Split dx = rate(x, u) dt + sigma(x) dW into f and g.

        Args:
            states: n symbols x.
            inputs: m symbols u.
            rate: n expressions of the states, inputs and parameters.
            diffusion: sigma, n x d; none by default.
            parameters: value of every other symbol that occurs.
            signals: rates of what is measured at run time; see the class.

        Returns:
            The system with the parts of the rate.

        Raises:
            SystemDefinitionError: the rate is not affine in the inputs, or see the class.
        """
        if not all(isinstance(given, list | tuple) and given for given in (states, inputs)):
            raise SystemDefinitionError(
                f"states = {states!r} and inputs = {inputs!r}; give lists of symbols, not empty"
            )
        parameters, signals = parameters or {}, signals or {}
        require_mappings(parameters, signals)
        require_real(states, inputs, parameters, signals)
        column = read_matrix("rate", rate, (len(states), 1))
        used = set(inputs)
        effect = column.jacobian(list(inputs)).applyfunc(
            lambda e: sp.simplify(e) if e.free_symbols & used else e
        )
        for i, state in enumerate(states):
            for j, u in enumerate(inputs):
                if effect[i, j].free_symbols & used:
                    raise SystemDefinitionError(
                        f"the rate of {state} is not affine in the input {u}: its derivative is"
                        f" {effect[i, j]}. Take what is not affine for the input, or make the input"
                        " a state whose rate is the new input"
                    )
        drift = column.subs(dict.fromkeys(inputs, 0))
        rest = column - drift - effect * sp.Matrix(inputs)
        for state, entry, at_zero in zip(states, rest, drift, strict=True):
            if at_zero.has(sp.nan, sp.zoo, sp.oo, -sp.oo):
                raise SystemDefinitionError(
                    f"the rate of {state} has no value where the inputs are 0; cancel what divides"
                    " by an input"
                )
            if not is_zero(sp.expand(entry)):
                raise SystemDefinitionError(
                    f"the rate of {state} is not affine in the inputs: next to f + g u there is"
                    f" {entry}. Give f and g themselves where a system has several pieces"
                )
        return cls(tuple(states), tuple(inputs), drift, effect, diffusion, parameters, signals)

    def __hash__(self) -> int:
        return hash(
            (
                self.states,
                self.inputs,
                self.drift,
                self.input_matrix,
                self.diffusion,
                tuple(self.parameters.items()),
                frozenset(self.signals.items()),
            )
        )

    def _check_symbols(self) -> None:
        symbols = [*self.states, *self.inputs, *self.parameters, *self.signals]
        names = [s.name for s in symbols]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise SystemDefinitionError(
                "defined more than once among states, inputs, parameters and signals:"
                f" {', '.join(twice)}"
            )
        for name in ("drift", "input_matrix", "diffusion"):
            used: set[Any] = getattr(self, name).free_symbols
            if used & set(self.inputs):
                raise SystemDefinitionError(
                    f"{name} depends on the input {_names(used & set(self.inputs))}; the system"
                    " must be affine in the input: put what multiplies it into input_matrix"
                )
            self.require_known(name, used, allowed=(*self.measured, *self.parameters))
        for signal, rate in self.signals.items():
            if rate.free_symbols & set(self.inputs):
                raise SystemDefinitionError(
                    f"the rate of the signal {signal} depends on an input; what the inputs move is"
                    " a state: put it there, with its rate in the drift"
                )
            known = (*self.measured, *self.parameters)
            self.require_known(f"the rate of the signal {signal}", rate.free_symbols, known)

    def require_known(self, what: str, used: Iterable[Any], allowed: Sequence[sp.Symbol]) -> None:
        """Raise SystemDefinitionError if an expression uses a symbol that is not allowed in it.

        Args:
            what: name of the expression, for errors.
            used: its symbols.
            allowed: symbols that may occur.
        """
        unknown = set(used) - set(allowed)
        if unknown:
            raise SystemDefinitionError(
                f"{what} uses the unknown symbol {_names(unknown)}; allowed: {_names(allowed)}."
                f" Note: {advice_on_unknown(unknown, allowed)}"
            )

    @property
    def measured(self) -> tuple[sp.Symbol, ...]:
        """What is known at run time besides the parameters: states, signals and the time."""
        return (*self.states, *self.signals, TIME)

    @property
    def uses_time(self) -> bool:
        """Whether the time occurs in f, g, sigma or the rate of a signal."""
        return any(
            TIME in part.free_symbols
            for part in (self.drift, self.input_matrix, self.diffusion, *self.signals.values())
        )

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def noise_channels(self) -> tuple[int, ...]:
        """The columns of the diffusion that are not zero, for the parameters as they are."""
        diffusion = self.numeric(self.diffusion)
        return tuple(
            j for j in range(diffusion.cols) if any(entry != 0 for entry in diffusion[:, j])
        )

    @property
    def noisy(self) -> bool:
        """Whether there is any noise, for the parameters as they are."""
        return bool(self.noise_channels)

    @property
    def parameter_values(self) -> dict[str, float]:
        """The values of the parameters, by the names of their symbols."""
        return {p.name: value for p, value in self.parameters.items()}

    def with_parameters(self, **values: float) -> ControlAffineSDE:
        """Return the same system with other parameter values.

        Raises:
            ConfigurationError: a name is no parameter of the system, or a value is no finite
                number.
        """
        by_name = {p.name: p for p in self.parameters}
        for name in values:
            if name not in by_name:
                raise unknown("parameter", name, by_name)
        return replace(
            self, parameters={**self.parameters, **{by_name[k]: v for k, v in values.items()}}
        )

    def numeric(self, expression: Any) -> Any:
        """Return an expression or matrix with the parameters' values in place of their symbols."""
        # What is remembered must not change: a matrix is frozen first.
        given: Any = (
            sp.ImmutableMatrix(expression) if isinstance(expression, sp.MatrixBase) else expression
        )
        return _numeric(given, tuple(self.parameters.items()))

    def exact(self, expression: Any) -> Any:
        """Like `numeric`, with decimal values as rationals, so that terms cancel exactly."""
        return expression.subs({p: sp.Rational(repr(v)) for p, v in self.parameters.items()})


@lru_cache(maxsize=1024)
def _numeric(expression: Any, parameters: tuple[tuple[sp.Symbol, float], ...]) -> Any:
    used = expression.free_symbols
    numbers = {
        p: sp.Float(v, 17) if v != int(v) else sp.Integer(int(v))
        for p, v in parameters
        if p in used
    }
    # SymPy may take a second to find nothing in a long expression.
    found = expression.subs(numbers) if numbers else expression
    if found.has(sp.zoo, sp.nan, sp.oo, -sp.oo):
        values = ", ".join(f"{p} = {v:g}" for p, v in parameters)
        raise ConfigurationError(
            f"the system has no finite value for its parameters ({values}); look for a division"
            " by 0"
        )
    return found


def _names(symbols: Iterable[Any]) -> str:
    return ", ".join(sorted(str(s) for s in symbols))
