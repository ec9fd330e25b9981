"""The app that runs commands: all of them as `safe-envs`, or one as a script of its own.

Typer's own help draws boxes by rich, which cuts what is wide, and takes longer to import than all
the rest of a command that only prints its help.
"""

from __future__ import annotations

import inspect
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.lazy_attributes import package_version
from safe_envs.scripts.options.console import Quiet, UsageError, quietly, run, with_quiet

PANELS: dict[str, str] = {
    "What": (
        "system filter-spec policy trust algo method all against data state degree rate"
        " x lines backend address"
    ),
    "Time, start and bounds": "dt substeps horizon start input-bounds rate-limit barrier",
    "Filters": "filter knowledge objective learned estimator belief observe",
    "Noise and mismatch": (
        "noise plant model delay model-delay slew-limit measurement sensor-noise"
    ),
    "Training": (
        "n-timesteps set action intervention-penalty promise-curriculum curriculum-part cost-limit"
        " violation-limit eval-freq eval-episodes resume"
    ),
    "Tables and proofs": "best closed-loop bounds leaving cells inputs table spec check",
    "Statistics": (
        "episodes seed seeds repeats confidence refine monitoring rare particles"
        " repetitions simulate states"
    ),
    "Speed": "num-envs jobs engine threads quick seconds",
    "Output": (
        "out folder json latex episodes-out timing plot size pictures markdown page worst"
        " tensorboard compare float32 name clear quiet"
    ),
    "Other": "version install-completion show-completion help",
}
"""The options of each group, in the order of the help; an option means the same in all commands."""

_PANEL_OF = {option: panel for panel, options in PANELS.items() for option in options.split()}

EXAMPLES: dict[str, tuple[str, ...]] = {
    "evaluate": (
        "safe-envs evaluate StochasticDubins-v0",
        "safe-envs evaluate Scalar-v0 --filter none --filter scbf --episodes 10000",
        "safe-envs evaluate DubinsDisk-v0 --noise 0.2 --plant v=1.2 --plot out.pdf",
        "safe-envs evaluate Pendulum-v0 --policy my_policy.py:Policy --json out.json",
        "safe-envs evaluate --system my_system.py:problem --monitoring continuous",
        "safe-envs evaluate Pendulum-v0 --measurement default --estimator ekf",
    ),
    "identify": (
        "safe-envs identify Scalar-v0 --method bayesian --out learned.npz",
        "safe-envs identify CubicSDE-v0 --method ddscbf --set points=400 --out c.npz",
    ),
    "train": (
        "safe-envs train Pendulum-v0 --algo ppo --filter hocbf --out ppo",
        "safe-envs train Pendulum-v0 --algo sac --n-timesteps 50000 --out sac",
        "safe-envs train Pendulum-v0 --algo ppo-lag --violation-limit 0.01 --out lag",
        "safe-envs train Pendulum-v0 --algo ppo --filter hocbf --out ppo --resume",
    ),
    "leaderboard": (
        "safe-envs leaderboard Pendulum-v0 --out board --quick",
        "safe-envs leaderboard Pendulum-v0 --out board --pictures pictures --markdown",
    ),
    "study": ("safe-envs study filters-in-training Pendulum-v0 --out study --quick",),
    "best": (
        "safe-envs best StochasticDubins-v0",
        "safe-envs best Scalar-v0 --cells 2000 --check --plot value.png",
    ),
    "verify": (
        "safe-envs verify StochasticDubins-v0",
        "safe-envs verify Scalar-v0 --filter scbf --no-simulate --json verified.json",
    ),
    "certify": (
        "safe-envs certify Scalar-v0 --out certificate.json",
        "safe-envs certify CubicSDE-v0 --policy nominal --degree 6",
    ),
    "check": ("safe-envs check certificate.json --state 0.5",),
    "export": (
        "safe-envs export StochasticDubins-v0 --out filter",
        "safe-envs export Pendulum-v0 --filter hocbf --float32 --compare --out filter",
    ),
    "render": (
        "safe-envs render DubinsDisk-v0 --out episode.gif",
        "safe-envs render StochasticDubins-v0 --compare none,hocbf,scbf --out three.mp4",
    ),
    "sweep": ("safe-envs sweep sweep.yaml --out found --jobs 4",),
    "sweep-report": ("safe-envs sweep-report found --x noise --lines filter",),
    "list": ("safe-envs list", "safe-envs list --json -"),
    "doctor": ("safe-envs doctor",),
    "cache": ("safe-envs cache", "safe-envs cache --clear"),
    "demo": ("safe-envs demo --folder demo-results",),
}
"""Command lines at the end of the help of each command, of at most 78 characters."""


def panel_of(option: str) -> str | None:
    """Return the group of an option such as `--episodes`; None if it has none."""
    return _PANEL_OF.get(option.lstrip("-"))


_LETTERS = {int: "INTEGER", float: "FLOAT", Path: "PATH"}
"""Placeholders for the values of options without a metavar, by the type of the default."""

_ARGUMENTS = "What"

_WIDEST = 26
"""Characters of the column of options, at most."""

Entry = tuple[str, str]
"""An argument or an option as it is written, and what it means."""


class GroupedCommand(TyperCommand):
    """A command whose help has its options in groups and examples at the end."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """See `typer.core.TyperCommand.parse_args`; errors know whose options are wrong."""
        try:
            return super().parse_args(ctx, args)
        except UsageError as error:
            error.ctx = error.ctx or ctx
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """See `typer.core.TyperCommand.collect_usage_pieces`."""
        arguments = [p for p in self.get_params(ctx) if p.param_type_name == "argument"]
        return ["[OPTIONS]", *map(written, arguments)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """See `typer.core.TyperCommand.format_options`."""
        write_sections(formatter, sections_of(self.get_params(ctx)))

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """See `typer.core.TyperCommand.format_epilog`: examples."""
        examples = EXAMPLES.get(self.name or "", ())
        if examples:
            with formatter.section(heading("Examples")):
                formatter.write("".join(f"  {line}\n" for line in examples))


def sections_of(params: Iterable[Any]) -> dict[str, list[Entry]]:
    """Return the arguments and options of a command by the title of their group.

    Args:
        params: of the command, as Typer has them.
    """
    found: dict[str, list[Entry]] = {panel: [] for panel in PANELS}
    arguments = []
    for param in params:
        if param.param_type_name == "argument":
            arguments.append((written(param), param.help or ""))
        elif not param.hidden:
            panel = panel_of(max(param.opts, key=len)) or param.rich_help_panel or "Other"
            found[panel].append((written(param), with_default(param)))
    found[_ARGUMENTS][:0] = arguments
    return {panel: entries for panel, entries in found.items() if entries}


def _argument(param: Any) -> str:
    """Return an argument as usage lines write it: in brackets if it may be left out."""
    name = (param.metavar or param.name.upper()).strip("[].")
    return f"{name if param.required else f'[{name}]'}{'...' if param.nargs != 1 else ''}"


def written(param: Any) -> str:
    """Return an argument or an option as it is written, with a placeholder for its value."""
    if param.param_type_name == "argument":
        return _argument(param)
    names = ", ".join(sorted(param.opts, key=len))
    if param.is_flag:
        return " / ".join([names, *param.secondary_opts])
    return f"{names} {param.metavar or _LETTERS.get(type(param.default), 'TEXT')}"


def default_of(param: Any) -> str:
    """Return the default of an option that takes a value, as text; "" if it has none to show."""
    if isinstance(param.show_default, str):
        return param.show_default
    if param.is_flag or param.default is None or callable(param.default) or not param.show_default:
        return ""
    return str(param.default)


def with_default(param: Any) -> str:
    """Return what an option means, and its default in brackets."""
    default = default_of(param)
    note = "  [required]" if param.required else f"  [default: {default}]" * bool(default)
    return f"{param.help or ''}{note}"


def write_sections(formatter: Any, sections: dict[str, list[Entry]]) -> None:
    """Write groups of entries with their titles.

    Args:
        formatter: of the help.
        sections: by title.
    """
    names = [len(name) for entries in sections.values() for name, _ in entries]
    # All groups have the same columns; a longer name has a line of its own.
    column = max(length for length in names if length <= _WIDEST) + 4
    for title, entries in sections.items():
        with formatter.section(heading(title)):
            for name, text in entries:
                formatter.write(_entry(name, text, column, formatter.width))


def _entry(name: str, text: str, column: int, width: int) -> str:
    """Return the lines of an entry."""
    # Words are not divided at hyphens, as Click does: `--closed-loop` is to be found and copied.
    lines = [
        line
        for paragraph in text.split("\n\n")
        for line in textwrap.wrap(
            paragraph, width - column, break_on_hyphens=False, break_long_words=False
        )
    ]
    first = f"  {name}"
    if len(first) > column - 2:
        lines.insert(0, "")
    rows = [f"{first:<{column}}{lines[0] if lines else ''}"]
    return "".join(f"{row.rstrip()}\n" for row in (*rows, *(" " * column + s for s in lines[1:])))


def heading(title: str) -> str:
    """Return a title in bold, which only a terminal shows."""
    return typer.style(title, bold=True)


_NAME = "safe-envs"


@dataclass(frozen=True)
class CommandEntry:
    """A command as the help lists it; its module is imported when it is used.

    Attributes:
        name: of the command.
        panel: group of the help that it is in.
        place: MODULE:NAME of its function, whose parameters are the options.
        about: first sentence of its help.
    """

    name: str
    panel: str
    place: str
    about: str


class _Commands(MutableMapping[str, Any]):
    """Commands by name, each made when it is first asked for."""

    def __init__(self, entries: Sequence[CommandEntry]) -> None:
        self.entries = {entry.name: entry for entry in entries}
        self._made: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._made:
            module, _, function = self.entries[name].place.partition(":")
            self._made[name] = _made(name, getattr(import_module(module), function))
        return self._made[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._made[name] = command

    def __delitem__(self, name: str) -> None:
        del self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter({**self.entries, **self._made})

    def __len__(self) -> int:
        return len({**self.entries, **self._made})


class _Group(TyperGroup):
    """A group whose help lists the commands in groups, without importing them."""

    moved: Mapping[str, str] = {}

    def list_commands(self, ctx: Any) -> list[str]:
        """See `typer.core.TyperGroup.list_commands`."""
        return list(self.commands)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """See `typer.core.TyperGroup.resolve_command`; the error of a command that there is not."""
        if args[0] in self.moved and not ctx.resilient_parsing:
            raise ConfigurationError(
                f"the command {shown(args[0])} has moved; run {self.moved[args[0]]}"
            )
        known = args[0].startswith("-") or args[0] in self.commands
        # Completion, which is resilient, prints no error into the line that is being written.
        if not known and not ctx.resilient_parsing:
            raise ConfigurationError(
                f"unknown command {shown(args[0])};"
                f" {nearest(args[0], self.commands, f'`{_NAME} --help` lists all')}"
            )
        return super().resolve_command(ctx, args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """See `typer.core.TyperGroup.format_options`: the commands, and then the options."""
        found: dict[str, list[tuple[str, str]]] = {}
        entries = getattr(self.commands, "entries", {}).values()
        for entry in entries:
            found.setdefault(entry.panel, []).append((entry.name, entry.about))
        write_sections(formatter, found)
        options = [row for rows in sections_of(self.get_params(ctx)).values() for row in rows]
        write_sections(formatter, {"Options": options})

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """See `typer.core.TyperGroup.format_epilog`."""
        with formatter.section(heading("More")):
            formatter.write_text("`safe-envs COMMAND --help` lists the options of a command.")


def make_app(
    entries: Sequence[CommandEntry], moved: Mapping[str, str] | None = None
) -> typer.Typer:
    """Return the app of commands, which imports a command when it is used.

    Args:
        entries: in the order of the help.
        moved: what to run in place of commands that there were, by their names.
    """

    class OfEntries(_Group):
        def __init__(self, **attributes: Any) -> None:
            super().__init__(**attributes)
            self.commands, self.moved = _Commands(entries), moved or {}

    app = _bare_app(OfEntries)

    @app.callback()
    def options_of_all(
        context: typer.Context,
        quiet: Quiet = False,
        version: Annotated[
            bool,
            typer.Option(
                "--version", help="Print the version.", is_eager=True, callback=_print_version
            ),
        ] = False,
    ) -> None:
        """Safety-critical systems as Gymnasium envs, and safety filters over any policy."""
        context.with_resource(quietly(quiet))

    return app


def _bare_app(group: type[TyperGroup]) -> typer.Typer:
    return typer.Typer(
        name=_NAME,
        cls=group,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )


def _made(name: str, function: Callable[..., None]) -> Any:
    """Return the command of a function with its options as parameters."""
    app = _bare_app(TyperGroup)
    text = _unwrapped(inspect.getdoc(function))
    app.command(name, help=text, cls=GroupedCommand)(with_quiet(function))
    # With a callback Typer makes a group of any number of commands.
    app.callback()(lambda: None)
    found: Any = typer.main.get_command(app)
    return found.commands[name]


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"{_NAME} {package_version()}")
        raise typer.Exit


def run_app(app: typer.Typer, *words: str) -> None:
    """Run a command line; an error of the user ends it with the exit status 2.

    Args:
        app: with the commands.
        *words: before those of the command line.
    """
    arguments = [*words, *sys.argv[1:]]
    status = run(lambda: _command(app).main(arguments, prog_name=_NAME, standalone_mode=False))
    sys.exit(status if isinstance(status, int) else 0)


def run_alone(name: str, command: Callable[..., None]) -> None:
    """Run one command as a script, with the arguments of the script.

    Args:
        name: of the command.
        command: the function with its options as parameters.
    """
    place = f"{command.__module__}:{command.__name__}"
    app = make_app([CommandEntry(name, "Commands", place, "")])
    _command(app).commands[name] = _made(name, command)
    run_app(app, name)


def _unwrapped(text: str | None) -> str:
    """Return paragraphs as one line each, which are wrapped to the width of the terminal."""
    return re.sub(r"(?<!\n)\n(?!\n)", " ", text or "")


@cache
def _command(app: typer.Typer) -> Any:
    """Build the command once: Typer does so at every call, which takes longer than a command."""
    return typer.main.get_command(app)
