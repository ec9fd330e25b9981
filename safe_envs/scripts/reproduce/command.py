"""`safe-envs reproduce`: the tables and figures of the thesis, ours beside the print, on one page."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from safe_envs.errors import ConfigurationError, WorkersLostError, nearest
from safe_envs.scripts.options import completion, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import (
    Json,
    progress_bar,
    require_result,
    say,
    stdout,
    write_result,
)
from safe_envs.scripts.reports.tables import make_table

if TYPE_CHECKING:
    from safe_envs.scripts.reproduce.framework.artefact import Artefact, Sample

_ALL = "all"


def reproduce(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[all | NAME]...",
            help="Such as table-4.1 or figure-3.3; all by default.",
            autocompletion=completion.artefacts,
        ),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(min=1, help="Episodes of each rate; by default the thesis' numbers."),
    ] = None,
    seed: text_options.Seed = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Where results and the page go. What is in it already is not done again.",
        ),
    ] = Path("report"),
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="A twentieth of the work: to see that it works, not what comes out."
        ),
    ] = False,
    json_file: Json = None,
) -> None:
    """Compute the tables and figures of the thesis, and hold them against the print.

    Each gets a picture (PNG and SVG) or a table, a JSON file with all numbers, and, but for a quick
    run, a verdict from a fixed list by stated rules. DIR/index.html is one page with all that is in
    DIR by the same options, DIR/index.md the same as Markdown. What is computed is kept by its
    configuration and the version of the code: a run that was stopped goes on.
    """
    from safe_envs.scripts.reproduce.framework.artefact import Sample
    from safe_envs.scripts.reproduce.framework.page import write_page
    from safe_envs.scripts.reproduce.framework.store import read, require_same_sample

    require_result(json_file)
    sample = Sample(episodes, seed, quick)
    chosen = _chosen(names or [_ALL])
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"--out {out} cannot be made: {error.strerror}; give another folder"
        ) from error
    require_same_sample(out, _chosen([_ALL]), sample)
    missing = [artefact for artefact in chosen if read(out, artefact, sample) is None]
    with progress_bar(f"{len(missing)} of {len(chosen)} to do") as tell:
        failures = _compute(missing, sample, out, jobs, tell or (lambda _: None))
    found = [
        (artefact, *answer)
        for artefact in _chosen([_ALL])
        if (answer := read(out, artefact, sample)) is not None
    ]
    write_page(out, found, sample)
    reported = [entry for entry in found if entry[0] in chosen]
    _report(reported, sample, out)
    write_result(json_file, lambda: _document(reported, sample))
    if failures:
        raise ConfigurationError(
            "; ".join(f"{name} failed: {error}" for name, error in failures.items())
        )


def _chosen(names: Sequence[str]) -> list[Artefact]:
    from safe_envs.scripts.reproduce.catalogue import ARTEFACTS

    known = {artefact.name: artefact for artefact in ARTEFACTS}
    for name in names:
        if name != _ALL and name not in known:
            raise ConfigurationError(f"unknown artefact {name!r}; {nearest(name, [_ALL, *known])}")
    return [artefact for name, artefact in known.items() if _ALL in names or name in names]


def _compute(
    missing: Sequence[Artefact], sample: Sample, out: Path, jobs: int, tell: Callable[[float], None]
) -> dict[str, str]:
    """Compute and keep what is missing; return the errors of those that failed, which stop no
    others."""
    failures: dict[str, str] = {}
    names = [artefact.name for artefact in missing]
    ended = (
        _one_by_one(names, sample, out)
        if min(jobs, len(names)) < 2
        else _in_processes(names, sample, out, jobs)
    )
    try:
        for done, (name, error) in enumerate(ended, 1):
            if error is not None:
                failures[name] = f"{type(error).__name__}: {error}"
            tell(done / len(names))
    except KeyboardInterrupt:
        # A job manager tells this process only, and the others would compute on to their ends.
        for process in active_children():
            process.terminate()
        print(f"Stopped. The same command goes on after what is in {out}.", file=sys.stderr)
        raise
    return failures


Ended = Iterator[tuple[str, BaseException | None]]
"""Names of artefacts as they end, with their errors."""


def _one_by_one(names: Sequence[str], sample: Sample, out: Path) -> Ended:
    for name in names:
        try:
            compute_one(name, sample, out)
        except Exception as error:
            yield name, error
        else:
            yield name, None


def _in_processes(names: Sequence[str], sample: Sample, out: Path, jobs: int) -> Ended:
    """By a pool; what was lost with a process of it is computed again, each in a process of its
    own."""
    lost = []
    for name, error in _pooled(names, sample, out, min(jobs, len(names))):
        if isinstance(error, BrokenProcessPool):
            lost.append(name)
        else:
            yield name, error
    for name in lost:
        for _, error in _pooled([name], sample, out, 1):
            ended = isinstance(error, BrokenProcessPool)
            yield (
                name,
                (
                    WorkersLostError(
                        "its process was ended from outside, as for want of memory; use fewer jobs"
                    )
                    if ended
                    else error
                ),
            )


def _pooled(names: Sequence[str], sample: Sample, out: Path, jobs: int) -> Ended:
    from safe_envs.agents.jobs.processes import end_with_parent
    from safe_envs.scripts.reproduce.framework.store import source_checksum

    # Not by fork: torch's threads do not survive it.
    pool = ProcessPoolExecutor(
        jobs, mp_context=get_context("spawn"), initializer=end_with_parent, initargs=(os.getpid(),)
    )
    try:
        left: dict[Any, str] = {
            pool.submit(compute_one, name, sample, out, source_checksum()): name for name in names
        }
        for future in as_completed(left):
            yield left[future], future.exception()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def compute_one(name: str, sample: Sample, out: Path, source: str | None = None) -> None:
    """Compute an artefact and keep it; what a process of the pool does.

    Args:
        name: of the artefact.
        sample: how much is simulated.
        out: folder of the results.
        source: checksum of the code of the process that asks for it, if that is another one.

    Raises:
        ConfigurationError: the code has changed since then.
    """
    import torch

    from safe_envs.scripts.reproduce.framework.store import keep, source_checksum

    # Before the code that computes is read, since results are kept by this checksum.
    if source not in (None, source_checksum()):
        raise ConfigurationError("the code changed during the run; start it again")
    torch.set_num_threads(1)
    (artefact,) = _chosen([name])
    began = time.perf_counter()
    outcome = artefact.compute(sample)
    keep(out, artefact, sample, outcome, time.perf_counter() - began)


def _document(found: Sequence[tuple[Artefact, Any, float]], sample: Sample) -> dict[str, Any]:
    """What was asked for, with its verdict and all that came out."""
    from safe_envs.scripts.reproduce.framework.verdict import judge

    rows = []
    for artefact, outcome, seconds in found:
        judgement = judge(artefact, outcome, sample)
        verdict = {"verdict": judgement.verdict.value, "reasons": list(judgement.reasons)}
        rows.append(
            {"name": artefact.name, **verdict, "seconds": seconds, "outcome": outcome.document()}
        )
    return {"sample": asdict(sample), "artefacts": rows}


def _report(found: Sequence[tuple[Artefact, Any, float]], sample: Sample, out: Path) -> None:
    from safe_envs.scripts.reproduce.framework.verdict import judge

    table = make_table("llp", "artefact", "verdict", "because", tight=False)
    for artefact, outcome, _ in found:
        judgement = judge(artefact, outcome, sample)
        table.add_row(artefact.name, judgement.text, "; ".join(judgement.reasons))
    console = stdout()
    console.print(table)
    say(console, f"\nThe page: {out / 'index.html'}")


if __name__ == "__main__":
    run_alone("reproduce", reproduce)
