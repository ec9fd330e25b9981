"""Training of agents with a filter in the loop, which resumes after an interruption."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import torch

from safe_envs.agents.jobs import blas_threads
from safe_envs.agents.jobs.store import make_folder
from safe_envs.agents.training.checkpoints import remove_unfinished
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.run_folder import LOCK, prepare, require_folder
from safe_envs.agents.training.session import TrainingSession
from safe_envs.errors import ConfigurationError
from safe_envs.file_locks import locked


def train(
    training: Training,
    folder: Path,
    *,
    resume: bool = False,
    tensorboard: Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> float:
    """Train an agent, and leave in a folder the agent and the record of its training.

    The folder holds `config.json` with the versions, `progress.jsonl` with all that was logged,
    `evaluations.json`, the policy as `policy.npz` and as
    Stable-Baselines3's `model.zip` (with `normalization.pkl`, if observations are normalised),
    in `best` those with the highest return in an evaluation, whatever their safety, and the last
    checkpoint. Evaluations have episodes of their own, so that none of them is among those of
    `safe-envs evaluate`.

    Args:
        training: what to do.
        folder: a new one, or with `resume` that of an interrupted training. Nothing in it is run;
            Stable-Baselines3's files are not read.
        resume: go on after the last checkpoint.
        tensorboard: folder of logs for tensorboard, in which this training gets one named after its
            own.
        progress: receives the part of the training that is done, from 0 to 1.

    Returns:
        Processor time of the learning in seconds, over all its runs and without evaluations.

    Raises:
        ConfigurationError: the folder holds something else, another training writes to it, or it
            cannot be written, as on a full disk; or the training is not the one that is resumed.
    """
    torch.set_num_threads(training.threads)
    folder = Path(folder)
    if tensorboard is not None and find_spec("tensorboard") is None:
        raise ConfigurationError(
            "--tensorboard: tensorboard is not installed; install it with pip install"
            " safe-envs[tensorboard]"
        )
    require_folder(folder, training, resume)
    # Before a folder is made: the arguments may be refused.
    begun = None if resume else TrainingSession(training, folder)
    for wanted in (folder, *([] if tensorboard is None else [tensorboard])):
        make_folder(wanted)
    with locked(
        folder / LOCK,
        f"another training is writing to {folder} just now; wait until it has ended, or give"
        " another folder",
    ):
        # Another training may have begun in it meanwhile.
        require_folder(folder, training, resume)
        session = begun or TrainingSession(training, folder, resume=True)
        remove_unfinished(folder)
        if not resume:
            prepare(folder, training)
        session.log(tensorboard)
        with blas_threads.limited(training.threads):
            session.run(progress or (lambda _: None))
    return session.seconds
