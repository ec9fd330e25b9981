"""`safe-envs demo`: PPO learns to ride the edge of a disk, and a filter keeps it inside."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import ConfigurationError
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import (
    Json,
    progress_bar,
    require_result,
    say,
    stdout,
    write_result,
)

ENV_ID = "safe_envs/StochasticDubins-v0"
FILTERS = ("none", "hocbf", "scbf")

_STEPS = 100_000


def demo(
    folder: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Where the trained policy and the pictures go.")
    ] = Path("demo-results"),
    episodes: Annotated[int, typer.Option(min=1, help="Episodes for each filter.")] = 1000,
    json: Json = None,
) -> None:
    """Train PPO briefly without a filter, then compare it with the nominal controller.

    The safety of both is shown unfiltered and filtered.
    """
    from safe_envs.agents.evaluation.evaluate import evaluate
    from safe_envs.scripts.figures.evaluation import plot_evaluation
    from safe_envs.scripts.reports.evaluation import print_evaluation

    require_result(json)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"--folder {folder} cannot be made: {error.strerror}; give another one"
        ) from error
    console = stdout()
    policy = folder / "ppo"
    _train(policy)
    documents = []
    for actor in ("nominal", str(policy)):
        with progress_bar("Evaluating") as tell:
            answer = evaluate(ENV_ID, actor, FILTERS, episodes=episodes, progress=tell, record=True)
        print_evaluation(console, answer)
        documents.append(answer.document())
        picture = folder / f"{Path(actor).stem}.png"
        plot_evaluation(answer, picture)
        say(console, f"Picture: {picture}\n")
    write_result(json, lambda: {"folder": str(folder), "evaluations": documents})


def _train(policy: Path) -> None:
    """Train the policy, or finish its training."""
    from safe_envs.agents.training.config import Training
    from safe_envs.agents.training.trainer import train

    say(stdout(), f"Training PPO on {ENV_ID}, {_STEPS} steps without any filter ...")
    with progress_bar("Training PPO") as tell:
        seconds = train(
            Training.of(ENV_ID, "ppo", n_timesteps=_STEPS, eval_freq=_STEPS),
            policy,
            resume=os.path.exists(policy),
            progress=tell,
        )
    say(stdout(), f"Trained in {seconds:.0f} s of processor time and saved in {policy}\n")


if __name__ == "__main__":
    run_alone("demo", demo)
