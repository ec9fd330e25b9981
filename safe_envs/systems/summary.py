"""What a list of the registered envs tells, and which options each takes, without its problem.

The problems are stated in symbols, whose import takes longer than to print the list or to say that
an option is wrong. So what they say is kept in `summaries.json`, which a test compares with them;
`python -m safe_envs.systems.summary` writes it again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import get_data
from typing import Any

from safe_envs.errors import unknown
from safe_envs.problem.option_errors import (
    refused_bounds,
    refused_noise,
    require_bounds,
    require_period,
    unknown_start,
    wrong_start,
)
from safe_envs.problem.options import ProblemOptions
from safe_envs.systems import ENV_IDS, MODULES
from safe_envs.text import finite_number

_FILE = Path(__file__).with_name("summaries.json")


@dataclass(frozen=True)
class SystemSummary:
    """What there is to say of a registered env without its problem.

    Attributes:
        about: what is to be kept safe.
        states: names.
        inputs: names.
        degree: relative degree of each barrier, by its name.
        filter: the env's own.
        noise: level of each channel, by name.
        dt: control period in s.
        horizon: length of an episode in s.
        parameters: names, of the plant and of the model.
        barrier: names of the arguments of the barrier.
        starts: names of the initial distributions.
        features: names of the entries of the observation.
        sensors: standard deviation of each channel of the default sensor, by name.
    """

    about: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    degree: Mapping[str, int]
    filter: str
    noise: Mapping[str, float]
    dt: float
    horizon: float
    parameters: tuple[str, ...]
    barrier: tuple[str, ...]
    starts: tuple[str, ...]
    features: tuple[str, ...]
    sensors: Mapping[str, float]

    def require_options(self, title: str, options: Mapping[str, Any]) -> None:
        """Raise ConfigurationError for options that the env cannot have, whatever their values.

        Args:
            title: name of the env, for errors.
            options: arguments of `gym.make`.
        """
        given = ProblemOptions.of(title, options, self.barrier)
        for values in (given.plant, given.model):
            for name, value in (values or {}).items():
                if name not in self.parameters:
                    raise unknown("parameter", name, self.parameters)
                finite_number(f"parameter {name}", value)
        if given.noise is not None:
            levels = [given.noise] if isinstance(given.noise, int | float) else list(given.noise)
            if len(levels) not in (1, len(self.noise)) or not all(
                math.isfinite(level) and level >= 0 for level in levels
            ):
                raise refused_noise(given.noise, list(self.noise))
        if given.input_bounds is not None:
            pairs = (
                given.input_bounds
                if isinstance(given.input_bounds[0], list)
                else [given.input_bounds] * len(self.inputs)
            )
            if len(pairs) != len(self.inputs):
                raise refused_bounds(given.input_bounds, len(self.inputs))
            for name, (low, high) in zip(self.inputs, pairs, strict=True):
                require_bounds(name, low, high)
        if given.dt is not None:
            require_period(given.dt)
        names = (*self.states, *self.features, *self.sensors, *self.parameters)
        # Rates of the inputs become states.
        if given.rate_limit is not None:
            names += self.inputs
        if isinstance(given.measurement, list):
            from safe_envs.problem.measurement import require_names

            require_names(given.measurement, names)
        if given.rate_limit is None:
            self._require_start(given.start)

    def _require_start(self, start: Any) -> None:
        if isinstance(start, str):
            if start not in self.starts:
                raise unknown_start(start, self.starts, len(self.states))
        elif start is not None and len(start) != len(self.states):
            raise wrong_start(len(start), self.states)


@cache
def summaries() -> dict[str, SystemSummary]:
    """Return the summary of each registered env, by its full id."""
    # A package in a zip file has no path of its own.
    found = json.loads(get_data("safe_envs.systems", _FILE.name) or b"{}")

    def frozen(value: Any) -> Any:
        return tuple(value) if isinstance(value, list) else value

    return {
        env_id: SystemSummary(**{name: frozen(value) for name, value in found[env_id].items()})
        for env_id in ENV_IDS
    }


def summary_of(env_id: str) -> SystemSummary:
    """Return the summary of an env as its problem says it.

    Args:
        env_id: full id.
    """
    import inspect

    from safe_envs.dynamics.lie import relative_degree

    name = env_id.partition("/")[2].removesuffix("-v0")
    env = getattr(import_module(f"safe_envs.systems.{MODULES[name]}"), name)
    problem = env.make_problem()
    levels = {p.name: value for p, value in problem.plant.parameters.items()}
    return SystemSummary(
        about=" ".join((env.__doc__ or "").strip().partition("\n\n")[0].split()),
        states=tuple(s.symbol.name for s in problem.states),
        inputs=tuple(i.symbol.name for i in problem.inputs),
        degree={b.name: relative_degree(problem.model, b.expression) for b in problem.barriers},
        filter=problem.filter,
        noise={channel: levels[channel] for channel in problem.noise},
        dt=problem.dt,
        horizon=problem.horizon,
        parameters=tuple(levels),
        barrier=tuple(inspect.signature(env.problem_factory).parameters),
        starts=tuple(problem.starts),
        features=tuple(f.name for f in problem.features),
        sensors={channel.name: channel.noise for channel in problem.sensors},
    )


def write_summaries() -> None:
    """Write the file that `summaries` reads."""
    from safe_envs.files import write_json

    write_json(_FILE, {env_id: asdict(summary_of(env_id)) for env_id in ENV_IDS})


if __name__ == "__main__":
    write_summaries()
