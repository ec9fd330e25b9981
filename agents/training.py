"""Training Stable-Baselines3's agents with a filter in the loop: in parts that can be gone on with, each of them evaluated.

A training is cut into parts. Each begins with fresh episodes and with randomness of its own, which hangs on nothing but the
seed and the number of the part. So a training that was interrupted goes on after its last whole part exactly as it would have.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation import BARE, evaluate, package_versions
from agents.hyperparameters import hyperparameters, scheduled
from agents.problems import full_id, load_problem
from safe_envs.errors import ConfigurationError, nearest, require_whole
from safe_envs.files import write_atomically, write_json

PARTS = 10
"""Into how many parts a training is cut unless it is said otherwise."""

_OFF_POLICY = ("sac", "td3")
_CONFIG, _EVALUATIONS, _PROGRESS, _BEST = "config.json", "evaluations.json", "progress.jsonl", "best"
_STATE, _MODEL, _BUFFER, _SCALES = "state.json", "model.zip", "replay_buffer.pkl", "normalization.pkl"
_CHECKPOINT = "checkpoint_"

Told = Callable[[float], None]
"""Told the part of the training that is done, from 0 to 1."""


@dataclass(frozen=True)
class Training:
    """What is trained, on what, and for how long. JSON-able.

    Attributes:
        env_id: registered id.
        algorithm: "ppo", "a2c", "sac" or "td3".
        filter: text of the filter in the loop; None for the bare env.
        options: arguments of `gym.make`.
        knowledge: of the filter, "model" or "plant".
        n_timesteps: control periods over all copies of the env; None for the hyperparameters' number.
        num_envs: copies; None likewise.
        settings: hyperparameters in place of the file's, by the Zoo's names.
        seed: of everything random.
        action: on which an off-policy algorithm learns; see `agents.replay`.
        intervention_penalty: see `agents.sb3_env.make_sb3_env`.
        eval_freq: steps between evaluations, which are kept as checkpoints too; None for a tenth of the training.
        eval_episodes: of each evaluation.
        threads: of torch. Small networks are many times slower on several threads of a busy machine.

    Raises:
        ConfigurationError: a value is not allowed.
    """

    env_id: str
    algorithm: str
    filter: str | None = None
    options: dict[str, Any] = field(default_factory=dict)
    knowledge: str = "model"
    n_timesteps: int | None = None
    num_envs: int | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    action: str = "executed"
    intervention_penalty: float = 0.0
    eval_freq: int | None = None
    eval_episodes: int = 200
    threads: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "env_id", full_id(self.env_id))
        object.__setattr__(self, "filter", None if self.filter == BARE else self.filter)
        object.__setattr__(self, "options", {k: v for k, v in self.options.items() if v is not None})
        settings = self.hyperparameters
        for name, default in (("n_timesteps", "n_timesteps"), ("num_envs", "n_envs")):
            if getattr(self, name) is None:
                object.__setattr__(self, name, int(settings[default]))
        if self.eval_freq is None:
            object.__setattr__(self, "eval_freq", max(1, (self.n_timesteps or 0) // PARTS))
        for name, least in (("n_timesteps", 1), ("num_envs", 1), ("seed", 0), ("eval_freq", 1), ("eval_episodes", 1), ("threads", 1)):
            require_whole(name, getattr(self, name), least)
        from agents.replay import ACTIONS

        if self.action not in ACTIONS:
            raise ConfigurationError(f"action = {self.action!r}; {nearest(self.action, ACTIONS)}")

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """Those of the file, with `settings` in place of what they name."""
        return {**hyperparameters(self.algorithm, self.env_id), **self.settings}


def train(training: Training, folder: Path, *, resume: bool = False, tensorboard: Path | None = None, tell: Told | None = None) -> None:
    """Train an agent, and leave in a folder all that is needed to use it and to know how it came about.

    The folder holds `config.json` with the versions, `progress.jsonl` with all that was logged, `evaluations.json`, the policy as
    `policy.safetensors` with `policy.json` and as Stable-Baselines3's `model.zip`, in `best` those with the highest return in an
    evaluation, and the last checkpoint.

    Args:
        training: what to do.
        folder: a new one, or with `resume` that of an interrupted training, whose checkpoint is a pickle: resume only your own.
        resume: go on after the last checkpoint.
        tensorboard: folder of logs for tensorboard.
        tell: told how far the training is.

    Raises:
        ConfigurationError: the folder holds something else, or the training is not the one that is resumed.
    """
    import torch

    torch.set_num_threads(training.threads)
    if tensorboard is not None and find_spec("tensorboard") is None:
        raise ConfigurationError("--tensorboard: tensorboard is not installed; install it with pip install safe-envs[tensorboard]")
    _require_folder(folder, training, resume)
    session = _Session(training, folder)
    if not resume:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / _CONFIG, {"training": asdict(training), "versions": package_versions()})
    session.log(tensorboard)
    session.run(tell or (lambda _: None))


def _require_folder(folder: Path, training: Training, resume: bool) -> None:
    """Raise ConfigurationError unless the folder is new, or that of the same training."""
    path = folder / _CONFIG
    if not resume:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ConfigurationError(f"--out {folder} is not empty; give a new folder, or go on with the training in it by --resume")
        return
    if not path.is_file():
        raise ConfigurationError(f"--resume: {folder} holds no training; start it without --resume")
    known = json.loads(path.read_text())["training"]
    for name, value in json.loads(json.dumps(asdict(training))).items():
        if known.get(name) != value:
            raise ConfigurationError(
                f"--resume: the training in {folder} has {name} = {known.get(name)!r}, not {value!r}; give the same arguments"
            )


class _Session:
    """One run of a training, from its beginning or from a checkpoint."""

    def __init__(self, training: Training, folder: Path) -> None:
        from stable_baselines3.common.vec_env import VecMonitor

        from agents.figures import SafetyFigures
        from agents.sb3_env import make_sb3_env

        self._training, self._folder = training, folder
        self._settings = scheduled(training.hyperparameters)
        self._problem = load_problem(training.env_id, training.options)
        self._envs: Any = VecMonitor(
            make_sb3_env(
                training.env_id,
                training.num_envs or 1,
                training.filter,
                knowledge=training.knowledge,
                intervention_penalty=training.intervention_penalty,
                **training.options,
            )
        )
        self._figures = SafetyFigures()
        checkpoint = _last_checkpoint(folder)
        self._model = self._new_model() if checkpoint is None else self._restored(checkpoint)
        self._evaluations = [e for e in _read_list(folder / _EVALUATIONS) if e["timesteps"] <= self._model.num_timesteps]

    def log(self, tensorboard: Path | None) -> None:
        """Log to the folder, and to another one for tensorboard."""
        from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

        from agents.figures import ProgressLog

        folder = self._folder
        outputs: list[Any] = [ProgressLog(folder / _PROGRESS, self._model.num_timesteps)]
        if tensorboard is not None:
            outputs.append(TensorBoardOutputFormat(str(tensorboard)))
        self._model.set_logger(Logger(str(folder), outputs))

    def run(self, tell: Told) -> None:
        """Train part by part, from where the model is, and leave the finished policy."""
        total, model = self._training.n_timesteps or 0, self._model
        if model.num_timesteps > max((e["timesteps"] for e in self._evaluations), default=0):
            self._evaluate()
        while model.num_timesteps < total:
            self._train_part(min(_next_end(model.num_timesteps, self._training.eval_freq or 1), total), total, tell)
            self._keep_checkpoint()
            self._evaluate()
        _copy_policy(_last_checkpoint(self._folder) or self._folder, self._folder)
        self._envs.close()

    def _train_part(self, end: int, total: int, tell: Told) -> None:
        from stable_baselines3.common.callbacks import CallbackList, ConvertCallback
        from stable_baselines3.common.utils import set_random_seed

        model = self._model
        seed = int(np.random.SeedSequence(self._training.seed, spawn_key=(model.num_timesteps,)).generate_state(1)[0])
        set_random_seed(seed)
        model.action_space.seed(seed)
        self._envs.seed(seed)
        model._last_obs = None  # so that it begins with a reset

        def note(_: dict[str, Any], __: dict[str, Any]) -> bool:
            tell(min(model.num_timesteps / total, 1.0))
            return True  # anything else would end the training

        # Schedules are of the whole training, not of its part.
        of_part = model._update_current_progress_remaining
        model._update_current_progress_remaining = lambda done, _: of_part(done, total)
        try:
            model.learn(end - model.num_timesteps, CallbackList([self._figures, ConvertCallback(note)]), reset_num_timesteps=False)
        finally:
            del model._update_current_progress_remaining

    def _new_model(self) -> Any:
        settings, training = dict(self._settings), self._training
        for name in ("n_envs", "n_timesteps"):
            settings.pop(name)
        normalize = settings.pop("normalize", False)
        if normalize:
            from stable_baselines3.common.vec_env import VecNormalize

            self._envs = VecNormalize(
                self._envs, gamma=settings.get("gamma", 0.99), **(normalize if isinstance(normalize, Mapping) else {})
            )
        if "n_epochs" in settings:
            # A rollout of another number of copies than the file's is to be cut into whole batches all the same.
            settings["batch_size"] = math.gcd(settings["batch_size"], settings["n_steps"] * (training.num_envs or 1))
        if settings.pop("noise_type", None) == "normal":
            settings["action_noise"] = _action_noise(settings.pop("noise_std"), self._problem.plant.m)
        if training.algorithm in _OFF_POLICY and training.filter is not None:
            from agents.replay import replay_options

            returns = {"n_steps": settings.pop("n_steps", 1), "gamma": settings.pop("gamma", 0.99)}
            settings |= {"gamma": returns["gamma"], **replay_options(self._problem, training.action, **returns)}
        try:
            return _algorithm(training.algorithm)(env=self._envs, seed=training.seed, device="cpu", **settings)
        except (TypeError, ValueError, AssertionError) as error:
            raise ConfigurationError(f"{training.algorithm} does not take these hyperparameters: {error}; they are {settings}") from error

    def _restored(self, checkpoint: Path) -> Any:
        if (checkpoint / _SCALES).exists():
            from stable_baselines3.common.vec_env import VecNormalize

            self._envs = VecNormalize.load(str(checkpoint / _SCALES), self._envs)
        model = _algorithm(self._training.algorithm).load(checkpoint / _MODEL, env=self._envs, device="cpu")
        if (checkpoint / _BUFFER).exists():
            model.load_replay_buffer(checkpoint / _BUFFER)
        self._figures.counts = json.loads((checkpoint / _STATE).read_text())["counts"]
        return model

    def _keep_checkpoint(self) -> None:
        """Write a whole checkpoint beside the last one, and only then remove that."""
        from agents.weights import save_policy

        before = _checkpoints(self._folder)
        target = self._folder / f"{_CHECKPOINT}{self._model.num_timesteps:012d}"
        part = self._folder / f".{target.name}"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        self._model.save(part / _MODEL)
        if self._training.algorithm in _OFF_POLICY:
            self._model.save_replay_buffer(part / _BUFFER)
        scales = self._model.get_vec_normalize_env()
        if scales is not None:
            scales.save(str(part / _SCALES))
        save_policy(self._model, part, self._problem, scales)
        write_json(part / _STATE, {"timesteps": self._model.num_timesteps, "counts": self._figures.counts})
        part.rename(target)
        for old in before:
            shutil.rmtree(old)

    def _evaluate(self) -> None:
        """Evaluate the checkpoint as `safe-envs evaluate` would, and keep it if its return is the best so far."""
        training, model = self._training, self._model
        checkpoint = _last_checkpoint(self._folder)
        name = training.filter or BARE
        found = evaluate(
            training.env_id,
            str(checkpoint),
            [name],
            options=training.options,
            episodes=training.eval_episodes,
            seed=training.seed,
            knowledge=training.knowledge,
            bounds=False,
        )
        row = {k: v for k, v in found.rows[0].items() if k not in ("curve", "policy")}
        best = max((e["return_mean"] for e in self._evaluations), default=-np.inf)
        self._evaluations.append({"timesteps": model.num_timesteps, **row, "training": self._figures.figures()})
        if row["return_mean"] > best and checkpoint is not None:
            _copy_policy(checkpoint, self._folder / _BEST)
        write_json(self._folder / _EVALUATIONS, self._evaluations)
        for key in ("safety_rate", "ci_low", "ci_high", "return_mean"):
            model.logger.record(f"eval/{key}", row[key])
        model.logger.dump(model.num_timesteps)


def _read_list(path: Path) -> list[Any]:
    return json.loads(path.read_text()) if path.exists() else []


def _next_end(done: int, every: int) -> int:
    return (done // every + 1) * every


def _checkpoints(folder: Path) -> list[Path]:
    return sorted(folder.glob(f"{_CHECKPOINT}*"))


def _last_checkpoint(folder: Path) -> Path | None:
    found = _checkpoints(folder)
    return found[-1] if found else None


def _copy_policy(source: Path, target: Path) -> None:
    target.mkdir(exist_ok=True)
    for name in (_MODEL, "policy.safetensors", "policy.json"):
        write_atomically(target / name, lambda part, name=name: shutil.copyfile(source / name, part))


def _algorithm(name: str) -> Any:
    import stable_baselines3

    return getattr(stable_baselines3, name.upper())


def _action_noise(deviation: float, inputs: int) -> Any:
    from stable_baselines3.common.noise import NormalActionNoise

    return NormalActionNoise(np.zeros(inputs), np.full(inputs, deviation))
