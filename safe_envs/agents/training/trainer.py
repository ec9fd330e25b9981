"""Training Stable-Baselines3's agents with a filter in the loop: in parts that can be gone on with,
each of them evaluated.

Each part begins with randomness of its own, which hangs on nothing but the seed and the number of
steps until then; the episodes go on from one part to the next. So a training that was interrupted
goes on after its last whole part exactly as it would have.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.evaluate import BARE, evaluate, package_versions
from safe_envs.agents.jobs import blas_threads
from safe_envs.agents.training.algorithms import OFF_POLICY, SHOWN, new_model
from safe_envs.agents.training.checkpoints import (
    copy_policy,
    drop_replay_buffer,
    keep_checkpoint,
    last_checkpoint,
    remove_unfinished,
    restore_model,
    resume_episodes,
)
from safe_envs.agents.training.config import Training
from safe_envs.atomic_io import write_json, writing
from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import ConfigurationError, SafeEnvsError, shortened
from safe_envs.file_locks import locked
from safe_envs.registry import make_problem

_OF_EVALUATIONS = 2**32 - 1
"""Key of their seeds, which no number of steps is."""

_CONFIG, _EVALUATIONS, _PROGRESS, _BEST, _LOCK = (
    "config.json",
    "evaluations.json",
    "progress.jsonl",
    "best",
    ".lock",
)

_SHOWN = ("safety_rate", "ci_low", "ci_high", "return_mean")
"""Of an evaluation, what is logged and shown."""

_MOST_TEXT = 30_000_000
"""Bytes of a file of JSON, at most: an evaluation takes a thousand, and what is read may take 25
times as much memory."""

Told = Callable[[float], None]
"""Told the part of the training that is done, from 0 to 1."""


def train(
    training: Training,
    folder: Path,
    *,
    resume: bool = False,
    tensorboard: Path | None = None,
    tell: Told | None = None,
) -> float:
    """Train an agent, and leave in a folder all that is needed to use it and to know how it came
    about.

    The folder holds `config.json` with the versions, `progress.jsonl` with all that was logged,
    `evaluations.json`, the policy as `policy.npz` and as
    Stable-Baselines3's `model.zip` (beside it `normalization.pkl`, if observations are normalised),
    in `best` those with the highest return in an evaluation, whatever their safety, and the last
    checkpoint. Evaluations have episodes of their own, so that none of them is among those of
    `safe-envs evaluate`.

    Args:
        training: what to do.
        folder: a new one, or with `resume` that of an interrupted training. Nothing in it is run;
            Stable-Baselines3's files are not read.
        resume: go on after the last checkpoint.
        tensorboard: folder of logs for tensorboard, in which this training gets one by the name of
            its own.
        tell: told how far the training is.

    Returns:
        The processor's seconds that the learning took, in all its runs, evaluations left out.

    Raises:
        ConfigurationError: the folder holds something else, another training writes to it, or it
            cannot be written, as on a full disk; or the training is not the one that is resumed.
    """
    import torch

    torch.set_num_threads(training.threads)
    folder = Path(folder)
    if tensorboard is not None and find_spec("tensorboard") is None:
        raise ConfigurationError(
            "--tensorboard: tensorboard is not installed; install it with pip install"
            " safe-envs[tensorboard]"
        )
    _require_folder(folder, training, resume)
    # Before a folder is made for it: its arguments may be refused.
    begun = None if resume else _Session(training, folder)
    for wanted in (folder, *([] if tensorboard is None else [tensorboard])):
        try:
            wanted.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"the folder {shortened(wanted)} cannot be made: {error.strerror}; give another one"
            ) from error
    with locked(
        folder / _LOCK,
        f"another training is writing to {folder} just now; wait until it has ended, or give"
        " another folder",
    ):
        # Another training may have begun in it since.
        _require_folder(folder, training, resume)
        session = begun or _Session(training, folder, resume=True)
        _prepare(folder, training, resume)
        session.log(tensorboard)
        with blas_threads.limited(training.threads):
            session.run(tell or (lambda _: None))
    return session.seconds


def _prepare(folder: Path, training: Training, resume: bool) -> None:
    """Remove what is left over, and write what is trained."""
    remove_unfinished(folder)
    if not resume:
        with writing(folder):
            for name in (_EVALUATIONS, _PROGRESS):
                (folder / name).unlink(missing_ok=True)
        write_json(folder / _CONFIG, {"training": asdict(training), "versions": package_versions()})


def _require_folder(folder: Path, training: Training, resume: bool) -> None:
    """Raise ConfigurationError unless the folder is new, or that of the same training."""
    if not resume:
        # A training that did not reach its first checkpoint leaves nothing that could be lost.
        if os.path.isdir(folder) and {path.name for path in folder.iterdir()} <= {
            _CONFIG,
            _EVALUATIONS,
            _PROGRESS,
            _LOCK,
        }:
            return
        if os.path.exists(folder):
            what = "is not empty" if os.path.isdir(folder) else "is a file"
            raise ConfigurationError(
                f"--out {folder} {what}; give a new folder, or go on with the training in one by"
                " --resume"
            )
        return
    path = folder / _CONFIG
    if not os.path.isfile(path):
        raise ConfigurationError(
            f"--resume: {shortened(folder)} holds no training; start it without --resume"
        )
    try:
        known = _flat(_read(path)["training"])
    except (LookupError, OSError, RecursionError, TypeError, ValueError) as error:
        raise ConfigurationError(
            f"--resume: {path} cannot be read ({error}); it is damaged or altered: start anew in"
            " another folder"
        ) from error
    wanted = _flat(json.loads(json.dumps(asdict(training))))
    # What another system changes besides, such as a default, comes after it.
    for name in sorted(
        {*known, *wanted}, key=lambda name: (name != "env_id", name != "system", name)
    ):
        if known.get(name) != wanted.get(name):
            raise ConfigurationError(
                f"--resume: the training in {folder} has {name} = {known.get(name)!r}, not"
                f" {wanted.get(name)!r}; give the same arguments"
            )


def _flat(document: Mapping[str, Any]) -> dict[str, Any]:
    """A training's attributes, the hyperparameters and a system of one's own among them."""
    return {
        **document,
        **document["hyperparameters"],
        "hyperparameters": None,
        "system": document["options"].get("system"),
    }


class _Session:
    """One run of a training, from its beginning or from a checkpoint."""

    def __init__(self, training: Training, folder: Path, resume: bool = False) -> None:
        from stable_baselines3.common.vec_env import VecMonitor

        from safe_envs.agents.training.callbacks import SafetyFigures
        from safe_envs.agents.training.vec_env import make_sb3_env

        self.seconds = 0.0
        self._training, self._folder = training, folder
        self._problem = make_problem(training.env_id, **training.options)
        self._figures = SafetyFigures()
        envs = VecMonitor(
            make_sb3_env(
                training.env_id,
                training.num_envs,
                training.filter,
                knowledge=training.knowledge,
                intervention_penalty=training.intervention_penalty,
                **training.options,
            )
        )
        action = training.action if training.learns_on_executed else None
        self._model: Any = new_model(
            training.algorithm, envs, self._problem, training.hyperparameters, action, training.seed
        )
        checkpoint = last_checkpoint(folder) if resume else None
        if checkpoint is not None:
            self.seconds = restore_model(
                checkpoint, self._model, self._figures, training.n_timesteps
            )
        known = _read_evaluations(folder / _EVALUATIONS) if resume else []
        self._evaluations = [e for e in known if e["timesteps"] <= self._model.num_timesteps]

    def log(self, tensorboard: Path | None) -> None:
        """Log to the folder, and to another one for tensorboard."""
        from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

        from safe_envs.agents.training.callbacks import ProgressLog

        folder, done = self._folder, self._model.num_timesteps
        outputs: list[Any] = [ProgressLog(folder / _PROGRESS, done)]
        if tensorboard is not None:
            from torch.utils.tensorboard.writer import SummaryWriter

            of_run = TensorBoardOutputFormat(str(tensorboard / folder.resolve().name))
            of_run.writer.close()
            # What was logged after the checkpoint is logged anew.
            of_run.writer = SummaryWriter(
                of_run.writer.log_dir, purge_step=done + 1 if done else None
            )
            outputs.append(of_run)
        self._model.set_logger(Logger(str(folder), outputs))

    def run(self, tell: Told) -> None:
        """Train part by part, from where the model is, and leave the finished policy."""
        training, model, folder = self._training, self._model, self._folder
        checkpoint = last_checkpoint(folder)
        if checkpoint is not None and model.num_timesteps > max(
            (e["timesteps"] for e in self._evaluations), default=0
        ):
            self._evaluate(checkpoint)
        while model.num_timesteps < training.n_timesteps:
            end = (model.num_timesteps // training.eval_freq + 1) * training.eval_freq
            self._train_part(checkpoint, min(end, training.n_timesteps), tell)
            checkpoint = keep_checkpoint(folder, model, self._problem, self._figures, self.seconds)
            self._evaluate(checkpoint)
        if checkpoint is not None:
            copy_policy(checkpoint, folder)
            drop_replay_buffer(checkpoint)
        model.get_env().close()

    def _train_part(self, checkpoint: Path | None, end: int, tell: Told) -> None:
        from stable_baselines3.common.callbacks import CallbackList, ConvertCallback
        from stable_baselines3.common.utils import set_random_seed

        training, model = self._training, self._model
        seed = _child_seed(training.seed, model.num_timesteps)
        set_random_seed(seed)
        model.action_space.seed(seed)
        if checkpoint is None:
            model.get_env().seed(seed)
        else:
            resume_episodes(checkpoint, model, seed)

        def note(_: dict[str, Any], __: dict[str, Any]) -> bool:
            tell(min(model.num_timesteps / training.n_timesteps, 1.0))
            return True  # anything else would end the training

        # Schedules are of the whole training, not of its part.
        of_part = model._update_current_progress_remaining
        model._update_current_progress_remaining = lambda done, _: of_part(
            done, training.n_timesteps
        )
        began = time.process_time()
        try:
            model.learn(
                end - model.num_timesteps,
                CallbackList([self._figures, ConvertCallback(note)]),
                log_interval=4 if training.algorithm in OFF_POLICY else 1,
                reset_num_timesteps=False,
            )
        except (
            ArithmeticError,
            AssertionError,
            LookupError,
            RuntimeError,
            TypeError,
            ValueError,
        ) as error:
            if isinstance(error, SafeEnvsError):
                raise
            raise ConfigurationError(
                f"the training failed after {model.num_timesteps} steps ({type(error).__name__}:"
                f" {str(error)[:SHOWN]}): it diverged, or a hyperparameter is not allowed; they are"
                f" {str(training.hyperparameters)[:SHOWN]}"
            ) from error
        finally:
            del model._update_current_progress_remaining
        self.seconds += time.process_time() - began
        # What the last updates recorded would be lost if the training was interrupted now.
        model.logger.dump(model.num_timesteps)

    def _evaluate(self, checkpoint: Path) -> None:
        """Evaluate the checkpoint as `safe-envs evaluate` would, and keep it if its return is the
        best so far."""
        training, model = self._training, self._model
        seed = _child_seed(training.seed, _OF_EVALUATIONS)
        found = evaluate(
            training.env_id,
            str(checkpoint),
            [training.filter or BARE],
            options=training.options,
            episodes=training.eval_episodes,
            seed=seed,
            knowledge=training.knowledge,
            bounds=False,
        )
        row = {k: v for k, v in found.rows[0].items() if k not in ("curve", "policy")}
        best = max((e["return_mean"] for e in self._evaluations), default=-np.inf)
        self._evaluations.append(
            {
                "timesteps": model.num_timesteps,
                "seed": seed,
                **row,
                "training": self._figures.figures(),
            }
        )
        if row["return_mean"] > best:
            copy_policy(checkpoint, self._folder / _BEST)
        for key in _SHOWN:
            model.logger.record(f"eval/{key}", row[key])
        model.logger.dump(model.num_timesteps)
        write_json(self._folder / _EVALUATIONS, self._evaluations)


def _child_seed(seed: int, *key: int) -> int:
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0])


def _read_evaluations(path: Path) -> list[dict[str, Any]]:
    """The evaluations so far, if there are any."""
    if not path.exists():
        return []
    try:
        rows = _read(path)
        for row in rows:
            numbers = [
                row["timesteps"],
                *(row[name] for name in _SHOWN),
                row["training"]["violations"],
            ]
            if not all(
                type(number) in (int, float) and math.isfinite(number) for number in numbers
            ):
                raise ValueError(f"its numbers are {numbers}")
    except (LookupError, OSError, RecursionError, TypeError, ValueError) as error:
        raise ConfigurationError(
            f"--resume: {path} cannot be read ({error}); it is damaged or altered: start anew in"
            " another folder"
        ) from error
    return rows


def _read(path: Path) -> Any:
    """Return the content of a JSON file that is no larger than a training's can be."""
    return json.loads(read_bytes(path, _MOST_TEXT))
