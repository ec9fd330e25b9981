"""`safe-envs best`: how safe any policy can be from an env's starts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import require_whole
from safe_envs.files import require_writable
from safe_envs.scripts.options import evaluation_options, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, progress_bar, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env_at_state


@with_env_at_state
def best(
    env: EnvOptions,
    leaving: evaluation_options.Leaving = "violation",
    knowledge: Annotated[
        str,
        typer.Option(
            metavar="plant|model",
            callback=text_options.KNOWLEDGE,
            help="In whose world: the env's, or the model's.",
        ),
    ] = "plant",
    cells: evaluation_options.Cells = None,
    inputs: evaluation_options.Inputs = None,
    table: evaluation_options.Table = None,
    spec: Annotated[
        str,
        typer.Option(
            metavar="TEXT",
            help='What episodes are to meet in place of staying safe, such as "always safe &'
            ' eventually goal".',
        ),
    ] = "",
    episodes: Annotated[
        int, typer.Option(help="Episodes of the greedy policy's simulation; 0 for none.")
    ] = 1000,
    check: Annotated[
        bool,
        typer.Option("--check", help="Prove both ends by outward-rounded arithmetic."),
    ] = False,
    seed: text_options.Seed = 0,
    json: Json = None,
    plot: Annotated[
        Path | None, text_options.plot_option("Draw the value over the coordinates of the grid")
    ] = None,
    size: evaluation_options.Size = None,
) -> None:
    """Print how safe any policy can be from the env's starts, and how safe a greedy policy is.

    The largest probability of a safe episode lies between a lower and an upper end, which dynamic
    programming of the env's own step gives on a grid: no policy is above the upper end, and one is
    at least at the lower end. Both hold the error of the grid and are computed in floating point;
    --check proves them.
    The greedy policy takes the input of the largest value at each step; it is --policy best of
    evaluate.

    The table is kept in the user's cache, so that it is computed once.
    """
    from safe_envs.agents.evaluation.attainable import attainable_safety, certified
    from safe_envs.registry import make_problem, title_of
    from safe_envs.scripts.reports.best import BestAnswer, print_best
    from safe_envs.values.tables import ValueSettings

    require_whole("episodes", episodes, 0)
    require_whole("seed", seed, 0)
    reads = [*text_options.inputs_of(env.system), *([("--table", table)] if table else [])]
    text_options.require_outputs(json, plot, inputs=reads)
    size = evaluation_options.size_of(size, plot)
    if table is not None:
        require_writable(table)
    settings = ValueSettings(
        knowledge=knowledge,
        leaving=leaving,
        specification=spec,
        cells=evaluation_options.cells_of(cells),
        inputs=inputs,
    )
    known, arguments = env.full_id, env.arguments
    problem = make_problem(known, **arguments)
    with progress_bar("Computing") as tell:
        found, policy = attainable_safety(
            problem, settings, episodes=episodes, seed=seed, file=table, progress=tell
        )
    if check:
        with progress_bar("Checking") as tell:
            found = certified(found, policy, tell)
    config = {"env_id": known, "options": arguments, "seed": seed}
    answer = BestAnswer(title_of(known, arguments), config, problem, found)
    print_best(stdout(), answer)
    write_result(json, answer.document)
    if plot is not None:
        from safe_envs.scripts.figures.best import plot_attainable

        plot_attainable(found, policy, plot, title=answer.title, size=size)


if __name__ == "__main__":
    run_alone("best", best)
