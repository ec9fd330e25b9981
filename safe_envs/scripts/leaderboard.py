"""`safe-envs leaderboard`: agents over several seeds, with and without filters, and their cost."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from safe_envs.errors import ConfigurationError
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
from safe_envs.systems import ENV_IDS

if TYPE_CHECKING:
    from safe_envs.scripts.reports.leaderboard import LeaderboardReport

FEW = ("safe_envs/Pendulum-v0", "safe_envs/StochasticDubins-v0", "safe_envs/QuadrotorLimits-v0")
"""The envs of a leaderboard for which none is named: noise, noise and turns, several limits."""

QUICK = ("safe_envs/Pendulum-v0", "safe_envs/Scalar-v0", "safe_envs/QuadrotorLimits-v0")
"""Those of --quick, whose tables take seconds."""

_QUICK_SEEDS, _SEEDS = 2, 5


def leaderboard(
    env_ids: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ENV_ID",
            help=f"Envs; by default {', '.join(FEW)}, and with --quick {', '.join(QUICK)}.",
            autocompletion=completion.env_ids,
            callback=early_checks.known_envs,
        ),
    ] = None,
    all_envs: Annotated[bool, typer.Option("--all", help="Every env.")] = False,
    algo: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            autocompletion=completion.algorithms,
            callback=early_checks.known_algorithm,
            help="ppo, a2c, sac, td3, ppo-lag or sac-lag.",
        ),
    ] = "ppo",
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder of agents and results. Finished ones in it are kept.",
        ),
    ] = Path("leaderboard"),
    seeds: Annotated[
        int | None,
        typer.Option(min=1, help="Trainings of each variant; by default 5, or 2 with --quick."),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Episodes of each evaluation; by default 1000, or 100 with --quick."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed from which all others are derived.")] = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Processes on this machine.")] = 2,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Train for moments only: to check that it works, not how good agents are.",
        ),
    ] = False,
    best: Annotated[
        bool,
        typer.Option(
            "--best",
            help=(
                "Compute the best attainable safety of each env. Otherwise only results of this"
                " command that were computed before are shown."
            ),
        ),
    ] = False,
    pictures: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Draw return against violations of each env, as DIR/ENV.png."
        ),
    ] = None,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print Markdown, with links to the pictures.")
    ] = False,
    page: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the Markdown into a page, between its lines <!-- leaderboard --> and"
            " <!-- end of leaderboard -->.",
        ),
    ] = None,
    json_file: Json = None,
) -> None:
    """Train agents on envs, with and without filters, and compare safety, return and cost.

    Each variant is trained with several seeds. The tables show the interquartile mean over seeds
    with its bootstrap interval, the safety rate of all episodes of these agents, and the unsafe
    steps and the processor time of a training. The variants are the nominal controller, the agent,
    one with a limit on violations, the agent under the env's default filter and under a promise
    filter, and agents trained behind the default filter and behind a backup filter, where the
    algorithm and the env have them. All filters know the plant.
    """
    from safe_envs.agents.jobs.executor import Backend
    from safe_envs.agents.jobs.store import make_folder, package_versions
    from safe_envs.agents.training.leaderboard import board, require_no_older
    from safe_envs.agents.training.study import run_study
    from safe_envs.scripts.reports.leaderboard import (
        leaderboard_markdown,
        leaderboard_notes,
        leaderboard_tables,
        put_into,
    )
    from safe_envs.scripts.reports.tables import print_columns

    require_result(json_file)
    if all_envs and env_ids:
        raise ConfigurationError(
            f"--all and {', '.join(env_ids)} are given; leave one of the two out"
        )
    study = board(
        ENV_IDS if all_envs else env_ids or (QUICK if quick else FEW),
        algo=algo,
        seeds=seeds or (_QUICK_SEEDS if quick else _SEEDS),
        seed=seed,
        episodes=episodes or (100 if quick else 1000),
        quick=quick,
    )
    require_no_older(out)
    if page is not None:
        put_into(page, None)
    if pictures is not None:
        make_folder(pictures)
    with progress_bar("Leaderboard") as tell:
        found = run_study(
            study,
            out,
            Backend(jobs=jobs),
            tell or (lambda _: None),
            lambda text: print(text, file=sys.stderr, flush=True),
        )
    report = _report(found, out, best)
    if pictures is not None:
        _draw(report, pictures)
    written = leaderboard_markdown(report, _links(report, pictures, page))
    if page is not None:
        put_into(page, written)
    if markdown:
        print_markdown(written)
    else:
        for heading, columns in leaderboard_tables(report):
            say(stdout(), f"\n{heading}")
            print_columns(stdout(), columns[:1], columns[1:])
        for note in leaderboard_notes(report):
            say(stdout(), f"Note: {note}")
    settings = {"algo": algo, "seeds": study.seeds, "seed": seed, "episodes": study.episodes}
    settings |= {"quick": quick, "knowledge": study.knowledge}
    document = {"settings": settings, "versions": package_versions()}
    write_result(json_file, lambda: document | report.document())
    found.require_all()


def _report(found: Any, out: Path, best: bool) -> LeaderboardReport:
    """Return the statistics of a study, with what is known of what could be had."""
    from safe_envs.agents.training.leaderboard import (
        attainable_of,
        entry_of,
        safety_over_envs,
    )
    from safe_envs.scripts.reports.leaderboard import LeaderboardReport

    study = found.study
    entries = [
        entry_of(found, e, variant.name) for e in study.env_ids for variant in study.variants
    ]
    with progress_bar("Best attainable safety") as tell:
        known = attainable_of(study.env_ids, out, best, tell or (lambda _: None))
    return LeaderboardReport(
        found,
        tuple(entry for entry in entries if entry is not None),
        safety_over_envs(found),
        known,
    )


def _draw(report: LeaderboardReport, folder: Path) -> None:
    """Draw a picture for each env that has agents."""
    from safe_envs.scripts.figures.leaderboard import draw
    from safe_envs.scripts.reports.leaderboard import short_name

    study = report.found.study
    variants = [variant.name for variant in study.variants]
    for env_id in study.env_ids:
        rows = [row for row in report.found.rows if row.env_id == env_id]
        if rows:
            path = _picture(folder, env_id)
            draw(short_name(env_id), report.of(env_id), rows, variants, path)


def _picture(folder: Path, env_id: str) -> Path:
    from safe_envs.scripts.reports.leaderboard import short_name

    # Envs of other packages keep their namespace in their names.
    return folder / f"{short_name(env_id).replace('/', '-')}.png"


def _links(report: LeaderboardReport, folder: Path | None, page: Path | None) -> dict[str, str]:
    """Return links to the pictures, as they are written in a page."""
    from safe_envs.scripts.reports.leaderboard import link_from

    if folder is None:
        return {}
    return {
        env_id: link_from(page, _picture(folder, env_id))
        for env_id in report.found.study.env_ids
        if report.of(env_id)
    }


if __name__ == "__main__":
    run_alone("leaderboard", leaderboard)
