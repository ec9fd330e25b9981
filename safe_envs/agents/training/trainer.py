"""Training of agents with a filter in the loop, in parts, which resumes after an interruption.

Each part begins with randomness of its own, which depends only on the seed and the number of steps
until then; the episodes go on from one part to the next. So a training that was interrupted goes on
after its last whole part exactly as it would have.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import CallbackList, ConvertCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecMonitor

from safe_envs.agents.evaluation.evaluate import run_evaluation
from safe_envs.agents.evaluation.spec import UNFILTERED, EvaluationSpec, RunSettings
from safe_envs.agents.jobs import job
from safe_envs.agents.jobs.store import make_folder
from safe_envs.agents.training.algorithms import MOST_SHOWN, new_model
from safe_envs.agents.training.callbacks import CurriculumCallback, ProgressLog, SafetyFigures
from safe_envs.agents.training.checkpoints import (
    BEST,
    EVALUATIONS,
    LOCK,
    PROGRESS,
    SHOWN,
    copy_policy,
    drop_replay_buffer,
    keep_checkpoint,
    last_checkpoint,
    prepare,
    read_evaluations,
    remove_unfinished,
    require_folder,
    restore_model,
    resume_episodes,
)
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.constraint import judged, rank
from safe_envs.agents.training.hyperparameters import OFF_POLICY
from safe_envs.agents.training.vec_env import make_sb3_env
from safe_envs.engine.choice import engine_for
from safe_envs.errors import ConfigurationError, SafeEnvsError, install_extra
from safe_envs.files import locked, write_json
from safe_envs.registry import make_problem

_OF_EVALUATIONS = 2**32 - 1
"""Key of their seeds, which no number of steps is."""


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
    in `best` those with the highest return in an evaluation, whatever their safety but for a limit
    that they exceed, and the last checkpoint. Evaluations have episodes of their own, so that none
    of them is among those of `safe-envs evaluate`.

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
            f"--tensorboard: tensorboard is not installed; {install_extra('tensorboard')}"
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
        with job.limited(training.threads):
            session.run(progress or (lambda _: None))
    return session.seconds


class TrainingSession:
    """One run of a training, from its beginning or from a checkpoint.

    Attributes:
        seconds: processor time that the learning took, in all runs of the training so far.

    Args:
        training: what to do.
        folder: of the training.
        resume: go on after the last checkpoint.
    """

    def __init__(self, training: Training, folder: Path, resume: bool = False) -> None:
        self.seconds = 0.0
        self._training, self._folder = training, folder
        problem = make_problem(training.env_id, **training.options)
        self._problem = problem if training.estimator is None else problem.unmeasured
        self._figures = SafetyFigures()
        envs = VecMonitor(
            make_sb3_env(
                training.env_id,
                training.num_envs,
                training.filter,
                knowledge=training.knowledge,
                intervention_penalty=training.intervention_penalty,
                engine=engine_for(training.engine, training.n_timesteps),
                estimator=training.estimator,
                **training.env_options,
            )
        )
        action = training.action if training.learns_on_executed else None
        self._model: Any = new_model(
            training.algorithm,
            envs,
            self._problem,
            training.hyperparameters,
            action,
            training.seed,
            training.constraint,
        )
        checkpoint = last_checkpoint(folder) if resume else None
        if checkpoint is not None:
            self.seconds = restore_model(
                checkpoint, self._model, self._figures, training.n_timesteps
            )
        known = read_evaluations(folder) if resume else []
        self._evaluations = [e for e in known if e["timesteps"] <= self._model.num_timesteps]

    def log(self, tensorboard: Path | None) -> None:
        """Log to the folder of the training, and to one for tensorboard."""
        folder, done = self._folder, self._model.num_timesteps
        outputs: list[Any] = [ProgressLog(folder / PROGRESS, done)]
        if tensorboard is not None:
            from torch.utils.tensorboard.writer import SummaryWriter

            of_run = TensorBoardOutputFormat(str(tensorboard / folder.resolve().name))
            of_run.writer.close()
            # What was logged after the checkpoint is logged again.
            of_run.writer = SummaryWriter(
                of_run.writer.log_dir, purge_step=done + 1 if done else None
            )
            outputs.append(of_run)
        self._model.set_logger(Logger(str(folder), outputs))

    def run(self, progress: Callable[[float], None]) -> None:
        """Train part by part, from the state of the model, and leave the finished policy."""
        training, model, folder = self._training, self._model, self._folder
        checkpoint = last_checkpoint(folder)
        if checkpoint is not None and model.num_timesteps > max(
            (e["timesteps"] for e in self._evaluations), default=0
        ):
            self._evaluate(checkpoint)
        while model.num_timesteps < training.n_timesteps:
            end = (model.num_timesteps // training.eval_freq + 1) * training.eval_freq
            self._train_part(checkpoint, min(end, training.n_timesteps), progress)
            checkpoint = keep_checkpoint(folder, model, self._problem, self._figures, self.seconds)
            self._evaluate(checkpoint)
        if checkpoint is not None:
            copy_policy(checkpoint, folder)
            drop_replay_buffer(checkpoint)
        model.get_env().close()

    def _train_part(
        self, checkpoint: Path | None, end: int, progress: Callable[[float], None]
    ) -> None:
        training, model = self._training, self._model
        seed = _child_seed(training.seed, model.num_timesteps)
        set_random_seed(seed)
        model.action_space.seed(seed)
        if checkpoint is None:
            model.get_env().seed(seed)
        else:
            resume_episodes(checkpoint, model, seed)

        def note(_: dict[str, Any], __: dict[str, Any]) -> bool:
            progress(min(model.num_timesteps / training.n_timesteps, 1.0))
            return True  # anything else would end the training

        callbacks = [self._figures, ConvertCallback(note)]
        # Schedules refer to the whole training, not to its part.
        of_part = model._update_current_progress_remaining
        model._update_current_progress_remaining = lambda done, _: of_part(
            done, training.n_timesteps
        )
        if training.curriculum is not None:
            # Before the first reset of a training: its episodes begin there.
            training.curriculum.ask(model.get_env(), model.num_timesteps)
            callbacks.append(CurriculumCallback(training.curriculum))
        began = time.process_time()
        try:
            model.learn(
                end - model.num_timesteps,
                CallbackList(callbacks),
                log_interval=4 if training.algorithm in OFF_POLICY else 1,
                reset_num_timesteps=False,
            )
        except SafeEnvsError:
            raise
        except Exception as error:  # What a hyperparameter may raise has no limits.
            raise ConfigurationError(
                f"the training failed after {model.num_timesteps} steps ({type(error).__name__}:"
                f" {str(error)[:MOST_SHOWN]}): it diverged, or a hyperparameter is not allowed;"
                f" they are {str(training.hyperparameters)[:MOST_SHOWN]}"
            ) from error
        finally:
            del model._update_current_progress_remaining
        self.seconds += time.process_time() - began
        # What the last updates recorded would be lost if the training was interrupted now.
        model.logger.dump(model.num_timesteps)

    def _evaluate(self, checkpoint: Path) -> None:
        """Evaluate a checkpoint, and keep its policy if its return is the best so far."""
        training, model = self._training, self._model
        seed = _child_seed(training.seed, _OF_EVALUATIONS)
        spec = EvaluationSpec(
            training.env_id,
            str(checkpoint),
            (training.filter or UNFILTERED,),
            options=training.options,
            episodes=training.eval_episodes,
            seed=seed,
            knowledge=training.knowledge,
            bounds=False,
            best=False,
            estimator=training.estimator,
            compare_estimates=False,
        )
        # Policies that cannot be compiled can be trained behind compiled envs.
        engine = "numpy" if training.engine == "numpy" else "auto"
        found = run_evaluation(spec, RunSettings(engine=engine))
        row = {k: v for k, v in found.rows[0].as_dict().items() if k not in ("curve", "policy")}
        entry = {
            "timesteps": model.num_timesteps,
            "seed": seed,
            **row,
            "training": self._figures.figures(),
        }
        if training.limit_kind is not None:
            entry["constraint"] = judged(model.constraint, training.limit_kind, row)
        earlier = [rank(e) for e in self._evaluations]
        self._evaluations.append(entry)
        if not earlier or rank(entry) > max(earlier):
            copy_policy(checkpoint, self._folder / BEST)
        for key in SHOWN:
            model.logger.record(f"eval/{key}", row[key])
        model.logger.dump(model.num_timesteps)
        write_json(self._folder / EVALUATIONS, self._evaluations)


def _child_seed(seed: int, *key: int) -> int:
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0])
