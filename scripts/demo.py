"""`safe-envs demo`: PPO learns to ride the edge of a disk, and a filter keeps it inside."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agents.evaluation import evaluate
from agents.problems import load_problem, make_env
from agents.weights import save_policy
from safe_envs import SafeEnv
from safe_envs.errors import ConfigurationError
from scripts.console import progress_bar, stdout
from scripts.figure import draw
from scripts.table import print_evaluation

ENV_ID = "safe_envs/StochasticDubins-v0"
FILTERS = ("none", "hocbf", "scbf")

_STEPS = 100_000
_COPIES = 8


def demo(folder: Path, episodes: int = 1000) -> None:
    """Train PPO without a filter, and print and draw the safety of the nominal controller and of PPO.

    Args:
        folder: where the policy and the pictures go; it is made if need be.
        episodes: for each policy and filter.

    Raises:
        ConfigurationError: the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"--folder {folder} cannot be made: {error.strerror}; give another one") from error
    console = stdout()
    policy = folder / "ppo"
    console.print(f"Training PPO on {ENV_ID}, {_STEPS} steps without any filter ...", highlight=False)
    begun = time.perf_counter()
    with progress_bar("Training PPO") as tell:
        train(policy, tell)
    console.print(f"Trained in {time.perf_counter() - begun:.0f} s and saved in {policy}\n", highlight=False, markup=False)
    for actor in ("nominal", str(policy)):
        with progress_bar("Evaluating") as tell:
            answer = evaluate(ENV_ID, actor, FILTERS, episodes=episodes, progress=tell, record=True)
        print_evaluation(console, answer)
        picture = folder / f"{Path(actor).stem}.png"
        draw(answer, picture)
        console.print(f"Picture: {picture}\n", highlight=False, markup=False)


def train(folder: Path, tell: Callable[[float], None] | None = None, steps: int = _STEPS, seed: int = 0) -> None:
    """Train PPO on the unfiltered env, and save it.

    Args:
        folder: where the policy goes, as data and as `model.zip` of Stable-Baselines3.
        tell: told the part of the training that is done, from 0 to 1.
        steps: control periods, over all copies of the env.
        seed: of the training.
    """
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    # Small networks run many times slower on several threads of a busy machine.
    torch.set_num_threads(1)
    envs = make_vec_env(_make, n_envs=_COPIES, seed=seed)
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=128,
        batch_size=256,
        n_epochs=8,
        gamma=0.97,
        learning_rate=1e-3,
        policy_kwargs={"net_arch": [64, 64]},
        device="cpu",
        seed=seed,
    )

    def note(found: dict[str, Any], _: dict[str, Any]) -> bool:
        if tell is not None:
            tell(found["self"].num_timesteps / steps)
        return True  # anything else would end the training

    model.learn(steps, callback=note)
    save_policy(model, folder, load_problem(ENV_ID))
    model.save(folder / "model.zip")
    envs.close()


def _make() -> SafeEnv:
    return make_env(ENV_ID)
