"""`safe-envs study`: agents that a file describes, trained with several seeds and compared."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from safe_envs.scripts.options import completion, early_checks
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import (
    Json,
    print_markdown,
    progress_bar,
    require_result,
    say,
    stdout,
    write_result,
)
from safe_envs.scripts.reports.tables import print_columns

_QUICK: dict[str, Any] = {"n_timesteps": 1024, "eval_freq": 1024, "eval_episodes": 5}


def study(
    what: Annotated[
        str,
        typer.Argument(
            metavar="STUDY",
            help="filters-in-training, or a YAML file of your own.",
            show_default=False,
        ),
    ],
    env_ids: Annotated[
        list[str],
        typer.Argument(
            metavar="ENV_ID",
            help="Envs.",
            autocompletion=completion.env_ids,
            callback=early_checks.known_envs,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder of agents and results. Finished ones in it are kept.",
        ),
    ],
    seeds: Annotated[int, typer.Option(min=1, help="Trainings of each agent.")] = 5,
    seed: Annotated[int, typer.Option(min=0, help="Seed from which all others are derived.")] = 0,
    episodes: Annotated[
        int | None,
        typer.Option(min=1, help="Episodes of each evaluation; by default as in the file."),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes on this machine.")] = 2,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Train for moments only: to check that it works, not how good agents are.",
        ),
    ] = False,
    against: Annotated[
        str | None,
        typer.Option(
            metavar="AGENT",
            help="Show differences from these agents, seed by seed on the same episodes.",
        ),
    ] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown.")] = False,
    json_file: Json = None,
) -> None:
    """Train the agents of a study with several seeds, and compare them with and without filters.

    A study is a list of agents, each with its algorithm, its filter in the loop, hyperparameters
    and the filters that it is evaluated with. filters-in-training compares filters in the loop with
    filters in deployment only. Filters know the plant. An interrupted study continues with the same
    command.
    """
    from safe_envs.agents.jobs.executor import Backend
    from safe_envs.agents.jobs.store import package_versions
    from safe_envs.agents.training.study import Study, differences, read_study, run_study, summaries
    from safe_envs.scripts.reports.leaderboard import study_columns, study_markdown, study_notes

    require_result(json_file)
    read = read_study(what)
    variants = read.shortened(_QUICK) if quick else read.variants
    asked = Study(env_ids, variants, seeds, seed, episodes or read.episodes)
    if against is not None:
        read.require_agent(against)
    with progress_bar("Study") as tell:
        found = run_study(
            asked,
            out,
            Backend(jobs=jobs),
            tell or (lambda _: None),
            lambda text: print(text, file=sys.stderr, flush=True),
        )
    document: dict[str, Any] = {"study": what, "settings": _settings(asked, quick)}
    document |= {"against": against, "versions": package_versions()}
    document |= {"rows": [asdict(row) for row in found.rows], "missing": found.reasons()}
    for env_id in asked.env_ids:
        rows = (
            summaries(found, read.agents, env_id)
            if against is None
            else differences(found, read.agents, env_id, against)
        )
        heading = env_id if against is None else f"{env_id}: differences from {against}"
        document.setdefault("summaries", []).extend(asdict(row) for row in rows)
        if markdown:
            print_markdown(f"**{heading}**\n\n{study_markdown(rows, against is not None)}\n")
        else:
            say(stdout(), f"\n{heading}")
            columns = study_columns(rows, against is not None)
            print_columns(stdout(), columns[:2], columns[2:])
    for note in study_notes(found):
        say(stdout(), f"Note: {note}")
    write_result(json_file, lambda: document)
    found.require_all()


def _settings(asked: Any, quick: bool) -> dict[str, Any]:
    names = ("env_ids", "seeds", "seed", "episodes", "knowledge")
    return {**{name: getattr(asked, name) for name in names}, "quick": quick}


if __name__ == "__main__":
    run_alone("study", study)
