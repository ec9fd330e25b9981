"""`python -m thesis`: the figures, tables and examples of the thesis, next to ours."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import ConfigurationError, unknown
from safe_envs.scripts.options.console import (
    STDOUT,
    Json,
    Quiet,
    quietly,
    require_result,
    run,
    say,
    stdout,
    write_result,
)
from thesis.artefact import Sample, texts

_ALL = "all"
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
def thesis(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", help="Such as table-4.1; all by default."),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="Folder of results: what is in it is not computed again.")
    ] = Path("report"),
    quick: Annotated[
        bool, typer.Option("--quick", help="A twentieth of the work, to see that it works.")
    ] = False,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Of each rate; by default the thesis' numbers.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of all randomness.")] = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    json_file: Json = None,
    quiet: Quiet = False,
) -> None:
    """Compute artefacts of the thesis, compare them with the printed ones, and judge them.

    Each gets a picture (PNG, PDF and SVG) or a table, a JSON file with all numbers, and, but for a
    quick run, a verdict by stated rules. OUT/index.html and OUT/index.md show all that is in OUT by
    the same options. A run that was stopped goes on. Without any argument the artefacts are listed.
    """
    with quietly(quiet, silent=json_file == STDOUT):
        names = names or [_ALL]
        for name in names:
            if name not in (_ALL, *texts()):
                raise unknown("artefact", name, (_ALL, *texts()))
        chosen = [name for name in texts() if _ALL in names or name in names]
        require_result(json_file)
        _compute(chosen, Sample(episodes, seed, quick), out, jobs, json_file)


def _compute(chosen: list[str], sample: Sample, out: Path, jobs: int, json: Path | None) -> None:
    from safe_envs.agents.jobs.executor import Backend
    from safe_envs.agents.jobs.store import ResultStore
    from safe_envs.scripts.options.console import run_jobs
    from thesis.catalogue import ArtefactJob, code_checksum, read
    from thesis.report import Entry, document, print_entry, write_page

    ResultStore(out).require_same_options(texts(), asdict(sample))
    missing = [name for name in chosen if read(out, name, sample) is None]
    tasks = [ArtefactJob(name, sample, out, code_checksum()) for name in missing]
    backend = Backend(jobs=max(1, min(jobs, len(tasks))))
    failures = run_jobs(tasks, backend, out, f"{len(missing)} of {len(chosen)} to do")
    kept = {name: read(out, name, sample) for name in texts()}
    entries = [Entry(name, *found, sample) for name, found in kept.items() if found is not None]
    write_page(out, entries, sample)
    reported = [entry for entry in entries if entry.name in chosen]
    for entry in reported:
        print_entry(stdout(), entry)
    say(stdout(), f"\nThe page: {out / 'index.html'}")
    write_result(json, lambda: document(reported, sample))
    if failures:
        raise ConfigurationError("; ".join(f"{each.key} failed: {each.error}" for each in failures))


def main() -> None:
    """Run the command line, or list the artefacts; an error of the user ends it with status 2."""
    if not sys.argv[1:]:
        print("\n".join(f"{name:14} {text.title}" for name, text in texts().items()))
        return
    run(lambda: app(prog_name="python -m thesis", standalone_mode=False))


if __name__ == "__main__":
    main()
