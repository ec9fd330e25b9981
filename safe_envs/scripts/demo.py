"""`safe-envs demo`: PPO learns to ride the edge of a disk, and a filter keeps it inside."""

from __future__ import annotations

import os
from pathlib import Path

from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.trainer import train
from safe_envs.errors import ConfigurationError
from safe_envs.scripts.figures.evaluation_figure import draw
from safe_envs.scripts.options.console import (
    progress_bar,
    require_result,
    say,
    stdout,
    write_result,
)
from safe_envs.scripts.reports.evaluation_report import print_evaluation

ENV_ID = "safe_envs/StochasticDubins-v0"
FILTERS = ("none", "hocbf", "scbf")

_STEPS = 100_000


def demo(
    folder: Path, episodes: int = 1000, steps: int = _STEPS, json_file: Path | None = None
) -> None:
    """Train PPO without a filter, and print and draw the safety of the nominal controller and of
    PPO.

    Args:
        folder: where the policy and the pictures go; it is made if need be. A training that is in
            it is gone on with.
        episodes: for each policy and filter.
        steps: control periods of the training.
        json_file: where both evaluations go, if they are to.

    Raises:
        ConfigurationError: the folder cannot be made, or the file cannot be written.
    """
    require_result(json_file)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"--folder {folder} cannot be made: {error.strerror}; give another one"
        ) from error
    console = stdout()
    policy = folder / "ppo"
    _train(policy, steps)
    documents = []
    for actor in ("nominal", str(policy)):
        with progress_bar("Evaluating") as tell:
            answer = evaluate(ENV_ID, actor, FILTERS, episodes=episodes, progress=tell, record=True)
        print_evaluation(console, answer)
        documents.append(answer.document())
        picture = folder / f"{Path(actor).stem}.png"
        draw(answer, picture)
        say(console, f"Picture: {picture}\n")
    write_result(json_file, lambda: {"folder": str(folder), "evaluations": documents})


def _train(policy: Path, steps: int) -> None:
    """Train the policy, or finish its training."""
    console = stdout()
    say(console, f"Training PPO on {ENV_ID}, {steps} steps without any filter ...")
    with progress_bar("Training PPO") as tell:
        seconds = train(
            Training.of(ENV_ID, "ppo", n_timesteps=steps, eval_freq=steps),
            policy,
            resume=os.path.exists(policy),
            progress=tell,
        )
    say(console, f"Trained in {seconds:.0f} s of processor time and saved in {policy}\n")


if __name__ == "__main__":
    from safe_envs.scripts.cli import main

    main("demo")
