"""`safe-envs demo`: PPO learns to ride the edge of a disk, and a filter keeps it inside."""

from __future__ import annotations

import time
from pathlib import Path

from agents.evaluation import evaluate
from agents.training import Training, train
from safe_envs.errors import ConfigurationError
from scripts.console import progress_bar, stdout
from scripts.figure import draw
from scripts.table import print_evaluation

ENV_ID = "safe_envs/StochasticDubins-v0"
FILTERS = ("none", "hocbf", "scbf")

_STEPS = 100_000


def demo(folder: Path, episodes: int = 1000, steps: int = _STEPS) -> None:
    """Train PPO without a filter, and print and draw the safety of the nominal controller and of PPO.

    Args:
        folder: where the policy and the pictures go; it is made if need be. A policy that is there already is not trained again.
        episodes: for each policy and filter.
        steps: control periods of the training.

    Raises:
        ConfigurationError: the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"--folder {folder} cannot be made: {error.strerror}; give another one") from error
    console = stdout()
    policy = folder / "ppo"
    train_once(policy, steps)
    for actor in ("nominal", str(policy)):
        with progress_bar("Evaluating") as tell:
            answer = evaluate(ENV_ID, actor, FILTERS, episodes=episodes, progress=tell, record=True)
        print_evaluation(console, answer)
        picture = folder / f"{Path(actor).stem}.png"
        draw(answer, picture)
        console.print(f"Picture: {picture}\n", highlight=False, markup=False)


def train_once(policy: Path, steps: int) -> None:
    """Train the policy, or finish its training, unless that was done before."""
    console, training = stdout(), Training(ENV_ID, "ppo", n_timesteps=steps, eval_freq=steps)
    if (policy / "policy.json").exists():
        console.print(f"The policy in {policy} is not trained again.\n", highlight=False, markup=False)
        return
    console.print(f"Training PPO on {ENV_ID}, {steps} steps without any filter ...", highlight=False)
    begun = time.perf_counter()
    with progress_bar("Training PPO") as tell:
        train(training, policy, resume=(policy / "config.json").exists(), tell=tell)
    console.print(f"Trained in {time.perf_counter() - begun:.0f} s and saved in {policy}\n", highlight=False, markup=False)
