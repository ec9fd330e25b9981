"""`safe-envs reproduce`: the tables and figures of the thesis next to ours, on one page."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from safe_envs.errors import ConfigurationError
from safe_envs.scripts.options import completion, early_checks, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, require_result, say, stdout, write_result
from safe_envs.scripts.options.job_progress import run_jobs

if TYPE_CHECKING:
    from safe_envs.scripts.reproduce.framework.artefact import Artefact, Workload

_ALL = "all"


def reproduce(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME",
            help="Such as table-4.1 or figure-3.3; all by default.",
            autocompletion=completion.artefacts,
            callback=early_checks.known_artefacts,
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
    """Compute the tables and figures of the thesis, and compare them with the printed ones.

    Each gets a picture (PNG, PDF and SVG) or a table, a JSON file with all numbers, and, but for a
    quick run, a verdict from a fixed list by stated rules. DIR/index.html is one page with all that
    is in DIR by the same options, DIR/index.md the same as Markdown. What is computed is kept by
    its configuration and the version of the code: a run that was stopped goes on.
    """
    from safe_envs.agents.jobs.executor import Backend
    from safe_envs.agents.jobs.fingerprint import source_checksum
    from safe_envs.scripts.reproduce.framework.artefact import Workload
    from safe_envs.scripts.reproduce.framework.page import write_page
    from safe_envs.scripts.reproduce.framework.store import read, require_same_sample
    from safe_envs.scripts.reproduce.framework.summary import summary_document, summary_table

    require_result(json_file)
    sample = Workload(episodes, seed, quick)
    chosen = _chosen(names or [_ALL])
    require_same_sample(out, _chosen([_ALL]), sample)
    missing = [artefact for artefact in chosen if read(out, artefact, sample) is None]
    tasks = [ArtefactJob(each.name, sample, out, source_checksum()) for each in missing]
    backend = Backend(jobs=max(1, min(jobs, len(tasks))))
    failures = run_jobs(tasks, backend, out, f"{len(missing)} of {len(chosen)} to do")
    found = [
        (artefact, *answer)
        for artefact in _chosen([_ALL])
        if (answer := read(out, artefact, sample)) is not None
    ]
    write_page(out, found, sample)
    reported = [entry for entry in found if entry[0] in chosen]
    stdout().print(summary_table(reported, sample))
    say(stdout(), f"\nThe page: {out / 'index.html'}")
    write_result(json_file, lambda: summary_document(reported, sample))
    if failures:
        raise ConfigurationError("; ".join(f"{each.key} failed: {each.error}" for each in failures))


def _chosen(names: Sequence[str]) -> list[Artefact]:
    from safe_envs.scripts.reproduce.catalogue import ARTEFACTS

    return [artefact for artefact in ARTEFACTS if _ALL in names or artefact.name in names]


@dataclass(frozen=True)
class ArtefactJob:
    """The computation of an artefact, which keeps its result itself, in whatever process.

    Attributes:
        key: name of the artefact.
        sample: how much is simulated.
        out: folder of the results.
        source: checksum of the code of the process that asks for it.
    """

    key: str
    sample: Workload
    out: Path
    source: str

    def compute(self) -> None:
        """Compute the artefact and keep it.

        Raises:
            ConfigurationError: the code has changed since the command began.
        """
        import torch

        from safe_envs.agents.jobs.fingerprint import source_checksum
        from safe_envs.scripts.reproduce.framework.store import keep

        # Before the code that computes is imported, since results are kept by this checksum.
        if self.source != source_checksum():
            raise ConfigurationError("the code changed during the run; start it again")
        torch.set_num_threads(1)
        (artefact,) = _chosen([self.key])
        began = time.perf_counter()
        outcome = artefact.compute(self.sample)
        keep(self.out, artefact, self.sample, outcome, time.perf_counter() - began)


if __name__ == "__main__":
    run_alone("reproduce", reproduce)
