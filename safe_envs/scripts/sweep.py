"""`safe-envs sweep`: many evaluations from one file, on this machine or on a cluster."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import ConfigurationError
from safe_envs.scripts.options import early_checks, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import (
    Json,
    run_jobs,
    say,
    stdout,
    write_result,
)


def sweep(
    spec: Annotated[
        Path,
        typer.Argument(
            metavar="SPEC.yaml",
            callback=early_checks.file_that_is_there("name a YAML file that says what to sweep"),
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
            metavar="local|dask",
            help="Who computes: this machine, or the workers of a Dask cluster.",
        ),
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option(
            metavar="ADDR",
            help="Of the Dask scheduler: tcp://HOST:PORT.",
        ),
    ] = None,
    trust: text_options.Trust = False,
    engine: text_options.Engine = "auto",
    json: Json = None,
    plot: Annotated[
        Path | None, text_options.plot_option("Draw what sweep-report draws of the cells")
    ] = None,
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
    from safe_envs.scripts.reports.sweep import failures_text, sweep_document

    text_options.require_outputs(json, plot, inputs=[("SPEC", spec)])
    if jobs is not None and backend != "local":
        raise ConfigurationError(
            f"--jobs {jobs} is of this machine; with --backend {backend} all workers of the cluster"
            " compute"
        )
    place = Backend(backend, address, jobs or 2)
    found = read_sweep(spec, trust, engine)
    store = Store(out, found)
    before = len(found.cells) - len(store.missing)
    missing = store.missing
    failures = run_jobs(missing, place, out, f"{len(missing)} cells to do", store.keep)
    # Another run may have computed one of them meanwhile.
    left = {cell.key for cell in store.missing}
    failures = [outcome for outcome in failures if outcome.key in left]
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
    if plot is not None:
        from safe_envs.agents.sweeps.store import read
        from safe_envs.scripts.figures.sweep import draw

        say(stdout(), draw(read(out).to_pylist(), found.swept, plot))
    write_result(json, lambda: {**counts, **sweep_document(found, failures)})
    if failures:
        raise ConfigurationError(failures_text(found, failures))


if __name__ == "__main__":
    run_alone("sweep", sweep)
