"""The `safe-envs` command."""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer

from safe_envs.scripts.evaluate import evaluate
from safe_envs.scripts.identify import identify
from safe_envs.scripts.leaderboard import leaderboard
from safe_envs.scripts.options.console import Json, Quiet, quietly, run, with_quiet
from safe_envs.scripts.render import render
from safe_envs.scripts.reproduce.command import reproduce
from safe_envs.scripts.sweep import sweep
from safe_envs.scripts.sweep_report import sweep_report
from safe_envs.scripts.train import train
from safe_envs.scripts.verify import verify

app = typer.Typer(
    name="safe-envs",
    help="Safety-critical systems as Gymnasium envs, and safety filters over any policy.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for command in (
    evaluate,
    identify,
    train,
    leaderboard,
    verify,
    render,
    reproduce,
    sweep,
    sweep_report,
):
    app.command(command.__name__.replace("_", "-"))(with_quiet(command))


@app.callback()
def options_of_all(context: typer.Context, quiet: Quiet = False) -> None:
    """Safety-critical systems as Gymnasium envs, and safety filters over any policy."""
    context.with_resource(quietly(quiet))


@app.command("list")
@with_quiet
def list_command(json: Json = None) -> None:
    """List the registered envs."""
    from safe_envs.scripts.listing import list_envs

    list_envs(json)


@app.command("doctor")
@with_quiet
def doctor_command(json: Json = None) -> None:
    """Check the installation: packages and extras, the solvers against known answers, every env
    with its filter, and the speed."""
    from safe_envs.scripts.doctor import doctor

    doctor(json)


@app.command("demo")
@with_quiet
def demo_command(
    folder: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Where the trained policy and the pictures go.")
    ] = Path("demo-results"),
    episodes: Annotated[int, typer.Option(min=1, help="Episodes for each filter.")] = 1000,
    json: Json = None,
) -> None:
    """Train PPO briefly without a filter, then show the safety of it and of the nominal controller,
    bare and filtered."""
    from safe_envs.scripts.demo import demo

    demo(folder, episodes, json_file=json)


@app.command("benchmark")
@with_quiet
def benchmark_command(
    json: Json = None,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Of an earlier run with --json: print the ratios to it."),
    ] = None,
) -> None:
    """Measure the speed of filters and envs."""
    from safe_envs.scripts.benchmark import benchmark

    benchmark(json, compare)


def main(command: str | None = None) -> None:
    """Entry point of the console command: errors of the user's making exit with status 2.

    Args:
        command: the one to run, for a script that is one; that of the command line by default.
    """
    run(
        lambda: _command()(
            None if command is None else [command, *sys.argv[1:]], prog_name="safe-envs"
        )
    )


@cache
def _command() -> Any:
    """Build the command with its options; Typer does so at every call, which takes longer than to
    run a quick one."""
    return typer.main.get_command(app)


if __name__ == "__main__":
    main()
