"""The options that name an env and its problem, once for all commands."""

from __future__ import annotations

import functools
import inspect
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, fields
from typing import Annotated, Any, get_type_hints

import typer

from safe_envs.problem.options import SENSOR_OPTIONS, ProblemOptions
from safe_envs.scripts.options import completion
from safe_envs.scripts.options.console import with_signature
from safe_envs.systems import ENV_IDS

_KINDS = get_type_hints(ProblemOptions)


def _annotation(option: Field[Any]) -> Any:
    """Return the annotation by which typer reads an option."""
    text = list[str] if option.metadata["repeatable"] else str
    kind = _KINDS[option.name] if option.metadata["reader"] is None else text | None
    given = {name: option.metadata[name] for name in ("metavar", "help")}
    return Annotated[kind, typer.Option(min=option.metadata["least"], **given)]


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


_OPTIONS: dict[str, Any] = {
    "env_id": Annotated[
        str | None,
        typer.Argument(
            metavar="ENV_ID",
            help="Registered id; `safe-envs list` shows all.",
            show_default=False,
            autocompletion=completion.env_ids,
        ),
    ],
    "system": Annotated[
        str | None,
        typer.Option(
            metavar="FILE.py:NAME",
            help=(
                "In place of ENV_ID: a SafetyProblem of your own or a function that returns one."
                " Runs the file. Or the name of a system that another package installed."
            ),
        ),
    ],
    **{option.name: _annotation(option) for option in fields(ProblemOptions)},
}


@dataclass(frozen=True)
class EnvOptions:
    """Which env a command line asks for.

    Attributes:
        env_id: as it was given, if it was.
        system: place of a system of one's own, FILE.py:NAME, if it was given.
        changes: the other options that were given, by name: texts, numbers, and lists of texts.
    """

    env_id: str | None
    system: str | None
    changes: Mapping[str, Any]

    @property
    def full_id(self) -> str:
        """The id that gym knows.

        Raises:
            ConfigurationError: there is no such id, or not just one of ENV_ID and --system was
                given.
        """
        # Not imported before it is needed: completion has to be quick.
        from safe_envs.registry import which_env

        return which_env(self.env_id, self.system)

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of `gym.make` that were given.

        Raises:
            ConfigurationError: a text cannot be read.
        """
        system = {} if self.system is None else {"system": self.system}
        return system | {
            option.name: value if reader is None else reader(_flag(option.name), value)
            for option in fields(ProblemOptions)
            for value in (self.changes.get(option.name),)
            for reader in (option.metadata["reader"],)
            if value is not None
        }

    def require_known(self, filters: Sequence[str] = ()) -> None:
        """Check the env, its options and its filters by what is known without its problem.

        Args:
            filters: their texts.

        Raises:
            ConfigurationError: The env is unknown, or cannot have an option.
            RelativeDegreeError: A filter does not suit a barrier.
        """
        from safe_envs.filters.conditions.names import AT_STATE
        from safe_envs.filters.conditions.syntax import require_degrees
        from safe_envs.registry import require_own
        from safe_envs.systems.summary import summaries

        env_id, arguments = self.full_id, self.arguments
        if env_id not in ENV_IDS:
            require_own(env_id)
            return
        summary = summaries()[env_id]
        if arguments:
            title = env_id.partition("/")[2].removesuffix("-v0")
            summary.require_options(title, arguments)
        # Where rates are limited, they are the inputs, and the degree is another one.
        if "rate_limit" not in arguments:
            for text in filters:
                require_degrees(text.removesuffix(AT_STATE), summary.degree)

    def evaluate_command(self, *words: str) -> str:
        """Return a command line that evaluates something in the same env, quoted for a shell.

        Args:
            *words: what else is to stand in it.
        """
        env = [self.full_id] if self.system is None else ["--system", self.system]
        changes = [
            f"{_flag(name)}={text}"
            for name, value in self.changes.items()
            for text in (value if isinstance(value, list) else [value])
        ]
        return shlex.join(["safe-envs", "evaluate", *env, *words, *changes])


def with_env(command: Callable[..., None], without: Sequence[str] = ()) -> Callable[..., None]:
    """Return a command's function with the options of an env in place of its parameter `env`.

    Args:
        command: the function, which is handed an `EnvOptions`.
        without: names of options that it does not take.
    """
    options = {name: option for name, option in _OPTIONS.items() if name not in without}

    @functools.wraps(command)
    def wrapped(**arguments: Any) -> None:
        given = {name: arguments.pop(name, None) for name in options}
        changes = {
            name: value
            for name, value in given.items()
            if name not in ("env_id", "system") and value not in (None, [])
        }
        env = EnvOptions(given["env_id"], given["system"], changes)
        # A third-party env need not be among the ids; its name shows to be wrong when it is made.
        if not arguments.get("filter_spec"):
            filters = arguments.get("filters") or [arguments.get("filter_name")]
            env.require_known([text for text in filters if text])
        command(env=env, **arguments)

    found: list[inspect.Parameter] = []
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        of_env = [
            parameter.replace(name=name, default=None, annotation=option)
            for name, option in options.items()
        ]
        found += of_env if parameter.name == "env" else [parameter]
    return with_signature(wrapped, found)


with_env_at_state = functools.partial(with_env, without=SENSOR_OPTIONS)
"""`with_env` for commands that know the true state, to which a sensor would make no difference."""
