"""Jobs of a command, with a progress bar, until all are done or the user stops them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from safe_envs.scripts.options.console import progress_bar
from safe_envs.text_lines import visible

if TYPE_CHECKING:
    from safe_envs.agents.jobs.executor import Backend
    from safe_envs.agents.jobs.job import Job, JobOutcome


def run_jobs(
    jobs: Sequence[Job],
    backend: Backend,
    out: Path,
    title: str,
    keep: Callable[[JobOutcome], None] = lambda _: None,
) -> list[JobOutcome]:
    """Compute jobs with a progress bar.

    Args:
        jobs: what to compute.
        backend: where.
        out: folder of the results, from which the same command resumes after a stop.
        title: of the progress bar.
        keep: receives each outcome as soon as it exists.

    Returns:
        The outcomes of the jobs that failed.
    """
    from safe_envs.agents.jobs.executor import run

    ended: list[JobOutcome] = []
    with progress_bar(title) as tell:

        def note(outcome: JobOutcome) -> None:
            keep(outcome)
            ended.append(outcome)
            if tell:
                tell(len(ended) / len(jobs))

        try:
            run(jobs, backend, note, lambda text: print(text, file=sys.stderr, flush=True))
        except KeyboardInterrupt:
            where = visible(str(out))
            print(f"Stopped. The same command goes on after what is in {where}.", file=sys.stderr)
            raise
    return [outcome for outcome in ended if outcome.error is not None]
