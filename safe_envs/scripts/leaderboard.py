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
            metavar="NAME",
            autocompletion=completion.algorithms,
            help="ppo, a2c, sac, td3, ppo-lag or sac-lag.",
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
    best: Annotated[
        bool,
        typer.Option(
            "--best",
            help=(
                "Compute the best attainable safety of each env; without it the table has it where"
                " that is in the cache."
            ),
        ),
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
    from safe_envs.agents.training.leaderboard import (
        LeaderboardOptions,
        attainable_of,
        leaderboard_rows,
    )
    from safe_envs.registry import full_id
    from safe_envs.scripts.reports.leaderboard_report import (
        leaderboard_markdown,
        leaderboard_notes,
        leaderboard_table,
    )

    require_result(json_file)
    ids = list(dict.fromkeys(full_id(env_id) for env_id in env_ids or ENV_IDS))
    options = LeaderboardOptions(algo, seed, quick, episodes or (100 if quick else 1000))
    with progress_bar("Leaderboard") as tell:
        rows = leaderboard_rows(ids, options, out, tell or (lambda _: None))
    with progress_bar("Best attainable safety") as tell:
        found = attainable_of(ids, best, tell or (lambda _: None))
    if markdown:
        say(stdout(), leaderboard_markdown(rows, found))
    else:
        stdout().print(leaderboard_table(rows, found))
    for note in leaderboard_notes(found):
        say(stdout(), f"Note: {note}")
    document = {"settings": asdict(options), "versions": package_versions()}
    known = {key: each if isinstance(each, str) else each.as_dict() for key, each in found.items()}
    document |= {"rows": [asdict(row) for row in rows], "best": known}
    write_result(json_file, lambda: document)


if __name__ == "__main__":
    run_alone("leaderboard", leaderboard)
