"""`safe-envs sweep`: many evaluations from one file, on this machine or on a cluster; a stopped one
goes on."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from safe_envs.errors import ConfigurationError
from safe_envs.scripts.options import text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import (
    Json,
    progress_bar,
    require_result,
    say,
    stdout,
    write_result,
)

if TYPE_CHECKING:
    from safe_envs.agents.jobs.executor import Backend
    from safe_envs.agents.sweeps.cell import Outcome
    from safe_envs.agents.sweeps.spec import Sweep
    from safe_envs.agents.sweeps.store import Store

_SHOWN = 10


def sweep(
    spec: Annotated[
        Path,
        typer.Argument(
            metavar="SPEC.yaml",
            help="What to sweep: sections fixed, grid and cells.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Where results go. Cells that are in it already are not computed again.",
        ),
    ],
    jobs: Annotated[
        int | None,
        typer.Option(min=1, help="Processes of this machine; by default 2.", show_default=False),
    ] = None,
    backend: Annotated[
        str,
        typer.Option(
            metavar="local|dask|ray",
            help="Who computes: this machine, or the workers of a cluster.",
        ),
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option(
            metavar="ADDR",
            help="Of the cluster: tcp://HOST:PORT of a Dask scheduler, HOST:PORT of Ray.",
        ),
    ] = None,
    trust: text_options.Trust = False,
    json: Json = None,
) -> None:
    """Evaluate each cell of a sweep: one env, filter, policy, seed and set of parameters.

    The file has settings under fixed, lists of values under grid, which multiply, and single cells
    under cells. All of it is checked before the first cell. Each result is written as it ends, with
    its configuration and versions: a run that was stopped goes on, and computes what is missing. A
    cell that fails is reported and stops no other. Results depend neither on the backend nor on the
    jobs.
    """
    from safe_envs.agents.jobs.executor import Backend
    from safe_envs.agents.sweeps.spec import read_sweep
    from safe_envs.agents.sweeps.store import Store

    require_result(json)
    if jobs is not None and backend != "local":
        raise ConfigurationError(
            f"--jobs {jobs} is of this machine; with --backend {backend} all workers of the cluster"
            " compute"
        )
    place = Backend(backend, address, jobs or 2)
    found = read_sweep(spec, trust)
    store = Store(out, found)
    before = len(found.cells) - len(store.missing)
    failures = _compute(store, place, out)
    done = len(found.cells) - len(store.missing)
    kept = f", of which {before} were there before" if before else ""
    say(stdout(), f"{done} of {len(found.cells)} cells are in {out}{kept}.")
    if store.hidden:
        hidden = (
            f"{store.hidden} cells of another grid or version are in {out} too, where no report"
            " reads them now"
        )
        say(stdout(), f"Note: {hidden}; give each sweep a folder of its own.")
    counts = {"cells": len(found.cells), "done": done, "before": before}
    write_result(json, lambda: _document(found, failures, counts))
    if failures:
        raise ConfigurationError(_told(found, failures))


def _document(found: Sweep, failures: Sequence[Outcome], counts: dict[str, int]) -> dict[str, Any]:
    from safe_envs.agents.sweeps.cell import versions

    errors = {outcome.key: outcome.error for outcome in failures}
    failed = [
        {"key": cell.key, "settings": cell.settings, "error": errors[cell.key]}
        for cell in found.cells
        if cell.key in errors
    ]
    return {**counts, "failed": failed, "swept": found.swept, "versions": versions()}


def _compute(store: Store, place: Backend, out: Path) -> list[Outcome]:
    """Compute what is missing; return the outcomes that failed, and that no other run has computed
    meanwhile."""
    from safe_envs.agents.jobs.executor import run

    missing, failures, done = store.missing, [], 0
    with progress_bar(f"{len(missing)} cells to do") as bar:
        tell = bar or (lambda _: None)

        def keep(outcome: Outcome) -> None:
            nonlocal done
            store.keep(outcome)
            done += 1
            failures.extend([outcome] * (outcome.error is not None))
            tell(done / len(missing))

        try:
            run(missing, place, keep, lambda text: print(text, file=sys.stderr, flush=True))
        except KeyboardInterrupt:
            print(f"Stopped. The same command goes on after what is in {out}.", file=sys.stderr)
            raise
    left = {cell.key for cell in store.missing}
    return [outcome for outcome in failures if outcome.key in left]


def _told(found: Sweep, failures: Sequence[Outcome]) -> str:
    """What failed and why, in the order of the file."""
    from safe_envs.agents.sweeps.spec import describe

    errors = {outcome.key: outcome.error for outcome in failures}
    lines = [
        f"{describe(cell, found.swept) or 'the only cell'}: {errors[cell.key]}"
        for cell in found.cells
        if cell.key in errors
    ]
    more = (
        [f"and {len(lines) - _SHOWN} more, which `safe-envs sweep-report` lists"]
        if len(lines) > _SHOWN
        else []
    )
    return "\n  ".join(
        [
            f"{len(lines)} of {len(found.cells)} cells failed; the same command tries them again:",
            *lines[:_SHOWN],
            *more,
        ]
    )


if __name__ == "__main__":
    run_alone("sweep", sweep)
