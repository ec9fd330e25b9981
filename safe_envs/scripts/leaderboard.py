"""`safe-envs leaderboard`: agents on every env, unfiltered and filtered, with what they cost."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from safe_envs import ENV_IDS
from safe_envs.scripts.options import completion
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import (
    Json,
    progress_bar,
    require_result,
    say,
    stdout,
    write_result,
)


def leaderboard(
    env_ids: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ENV_ID]...", help="Envs; by default all.", autocompletion=completion.env_ids
        ),
    ] = None,
    algo: Annotated[
        str,
        typer.Option(
            metavar="NAME", autocompletion=completion.algorithms, help="ppo, a2c, sac or td3."
        ),
    ] = "ppo",
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Where agents and results go. What is in it already is not done again.",
        ),
    ] = Path("leaderboard"),
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Episodes of each evaluation; by default 1000, or 100 with --quick."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all randomness.")] = 0,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Train for moments only: to see that it works, not how good agents get."
        ),
    ] = False,
    markdown: Annotated[
        bool,
        typer.Option("--markdown", help="Print the table as Markdown, with a row for each env."),
    ] = False,
    json_file: Json = None,
) -> None:
    """Train agents on each env, without and with its filter, and compare them with its controller.

    Each policy is evaluated without and with the filter, which knows the plant; the agent that was
    trained with it only so. The table has the safety rates with their 95 % intervals, the
    returns, and the processor time of the training. The intervals are of the episodes: there is one
    training of each kind, and another seed gives another agent.
    """
    from safe_envs.agents.jobs.fingerprint import package_versions
    from safe_envs.agents.training.leaderboard import LeaderboardOptions, leaderboard_rows
    from safe_envs.registry import full_id
    from safe_envs.scripts.reports.leaderboard_report import leaderboard_markdown, leaderboard_table

    require_result(json_file)
    ids = list(dict.fromkeys(full_id(env_id) for env_id in env_ids or ENV_IDS))
    options = LeaderboardOptions(algo, seed, quick, episodes or (100 if quick else 1000))
    with progress_bar("Leaderboard") as tell:
        rows = leaderboard_rows(ids, options, out, tell or (lambda _: None))
    if markdown:
        say(stdout(), leaderboard_markdown(rows))
    else:
        stdout().print(leaderboard_table(rows))
    document = {"settings": asdict(options), "versions": package_versions()}
    write_result(json_file, lambda: {**document, "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    run_alone("leaderboard", leaderboard)
