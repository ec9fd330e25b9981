"""Trainings that take a moment, and what they leave."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from safe_envs.agents.training.config import Training
from safe_envs.agents.training.trainer import train

DUBINS, SCALAR = "safe_envs/StochasticDubins-v0", "safe_envs/Scalar-v0"
NET = {"policy_kwargs": {"net_arch": [8]}}
OFF_POLICY: dict[str, Any] = {**NET, "learning_starts": 16, "batch_size": 16, "train_freq": 4}
OFF_POLICY["gradient_steps"] = 1
ON_POLICY = {**NET, "n_steps": 16, "batch_size": 16, "n_epochs": 1}
SETTINGS = {"ppo": ON_POLICY, "ppo-lag": ON_POLICY, "a2c": NET}
SMALL = {"num_envs": 2, "n_timesteps": 96, "eval_freq": 32, "eval_episodes": 2}


def training(algorithm: str = "ppo", changes: Any = None, env_id: str = DUBINS, **arguments: Any):
    """Three parts of a few steps; episodes of 10 steps do not end where they do."""
    options: dict[str, Any] = {"options": {"horizon": 0.5}}
    if env_id == SCALAR:  # of 10 steps as well, some of which are unsafe
        options = {"options": {"horizon": 0.1, "noise": 3.0, "start": [0.9]}}
    settings = SETTINGS.get(algorithm, OFF_POLICY) | (changes or {})
    return Training.of(
        env_id, algorithm, settings=settings, **{"filter": "scbf", **SMALL, **options} | arguments
    )


def stopped(wanted: Training, folder: Path, steps: int = 64) -> Path:
    """Train up to a checkpoint, and some steps more."""

    def stop(part: float) -> None:
        if part * wanted.n_timesteps > steps:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(wanted, folder, progress=stop)
    (checkpoint,) = folder.glob("checkpoint_*")
    return checkpoint


def logged(folder: Path) -> list[dict[str, float]]:
    """All that was logged, but for the clock."""
    lines = map(json.loads, (folder / "progress.jsonl").read_text().splitlines())
    return [{k: v for k, v in line.items() if not k.startswith("time/")} for line in lines]


def evaluations(folder: Path) -> list[dict[str, Any]]:
    return json.loads((folder / "evaluations.json").read_text())


def outcome(folder: Path):
    """All that a training leaves but for the clock."""
    return logged(folder), evaluations(folder), (folder / "policy.npz").read_bytes()
