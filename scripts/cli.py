"""The `safe-envs` command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scripts.console import run
from scripts.evaluate import evaluate
from scripts.identify import identify
from scripts.leaderboard import leaderboard
from scripts.render import render
from scripts.reproduce.command import reproduce
from scripts.train import train
from scripts.verify import verify

app = typer.Typer(
    name="safe-envs",
    help="Safety-critical systems as Gymnasium envs, and safety filters over any policy.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command("evaluate")(evaluate)
app.command("identify")(identify)
app.command("train")(train)
app.command("leaderboard")(leaderboard)
app.command("verify")(verify)
app.command("render")(render)
app.command("reproduce")(reproduce)


@app.command("list")
def list_command() -> None:
    """List the registered envs."""
    from scripts.listing import list_envs

    list_envs()


@app.command("demo")
def demo_command(
    folder: Annotated[Path, typer.Option(metavar="FOLDER", help="Where the trained policy and the pictures go.")] = Path("demo-results"),
    episodes: Annotated[int, typer.Option(min=1, help="Episodes for each filter.")] = 1000,
) -> None:
    """Train PPO briefly without a filter, then show the safety of it and of the nominal controller, bare and filtered."""
    from scripts.demo import demo

    demo(folder, episodes)


@app.command("benchmark")
def benchmark_command(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the measurements.")] = None,
) -> None:
    """Measure the speed of filters and envs."""
    from scripts.benchmark import benchmark

    benchmark(json)


def main() -> None:
    """Entry point of the console command: errors of the user's making exit with status 2."""
    run(app)
