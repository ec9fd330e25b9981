"""What is trained, on what, and for how long."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.training.algorithms import ACTIONS, OFF_POLICY, whole_batches
from safe_envs.agents.training.hyperparameters import hyperparameters
from safe_envs.errors import ConfigurationError, nearest, require_whole
from safe_envs.registry import full_id

_MOST_ROWS = 1_000_000

PARTS = 10
"""Into how many parts a training is cut unless it is said otherwise."""


@dataclass(frozen=True)
class Training:
    """What is trained, on what, and for how long. JSON-able; `Training.of` fills in what the
    hyperparameters say.

    Attributes:
        env_id: full id.
        algorithm: "ppo", "a2c", "sac" or "td3".
        filter: text of the filter in the loop; None for the bare env.
        options: arguments of `gym.make`.
        knowledge: of the filter, "model" or "plant".
        n_timesteps: control periods over all copies of the env.
        num_envs: copies.
        hyperparameters: of the algorithm, by the Zoo's names.
        seed: of everything random.
        action: on which an off-policy algorithm learns; see
            `safe_envs.agents.training.replay_buffer`.
        intervention_penalty: see `safe_envs.agents.training.vec_env.make_sb3_env`.
        eval_freq: steps between evaluations, which are kept as checkpoints too.
        eval_episodes: of each evaluation.
        threads: of torch and BLAS. Small networks are many times slower on several threads of a
            busy machine.

    Raises:
        ConfigurationError: a value is not allowed.
    """

    env_id: str
    algorithm: str
    filter: str | None
    options: dict[str, Any]
    knowledge: str
    n_timesteps: int
    num_envs: int
    hyperparameters: dict[str, Any]
    seed: int
    action: str
    intervention_penalty: float
    eval_freq: int
    eval_episodes: int
    threads: int

    def __post_init__(self) -> None:
        try:
            json.dumps(asdict(self), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ConfigurationError(
                f"a training is kept as JSON: {error}; give numbers, texts, lists and mappings"
            ) from error
        for name, least in (
            ("n_timesteps", 1),
            ("num_envs", 1),
            ("seed", 0),
            ("eval_freq", 1),
            ("eval_episodes", 1),
            ("threads", 1),
        ):
            require_whole(name, getattr(self, name), least)
        if self.seed >= 2**32:
            raise ConfigurationError(f"seed = {self.seed}; torch takes whole numbers below 2^32")
        if self.action not in ACTIONS:
            raise ConfigurationError(f"action = {self.action!r}; {nearest(self.action, ACTIONS)}")
        if self.action != ACTIONS[0] and not self.learns_on_executed:
            raise ConfigurationError(
                f"action = {self.action!r} is for SAC and TD3 behind a filter; leave it out: others"
                " learn on what they propose"
            )
        if self.action == ACTIONS[0] and self.learns_on_executed and self.intervention_penalty:
            raise ConfigurationError(
                "an intervention penalty is of the proposed action, and the executed one, on which"
                " is learned, has none; give --action both or proposed too, or no penalty"
            )

    @property
    def learns_on_executed(self) -> bool:
        """Whether there is a choice of the action on which is learned."""
        return self.algorithm in OFF_POLICY and self.filter is not None

    @classmethod
    def of(
        cls,
        env_id: str,
        algorithm: str,
        *,
        filter: str | None = None,  # noqa: A002  (the word of the whole project)
        options: Mapping[str, Any] | None = None,
        knowledge: str = "model",
        n_timesteps: int | None = None,
        num_envs: int | None = None,
        settings: Mapping[str, Any] | None = None,
        seed: int = 0,
        action: str = ACTIONS[0],
        intervention_penalty: float = 0.0,
        eval_freq: int | None = None,
        eval_episodes: int = 200,
        threads: int = 1,
    ) -> Training:
        """A training with the hyperparameters of `agents/hyperparams`, as far as nothing else is
        given.

        Args:
            env_id: registered id, with or without its namespace.
            algorithm: see the class, as all that is not named here.
            filter: text of the filter in the loop; None or "none" for the bare env.
            options: arguments of `gym.make`; those that are None are left out.
            knowledge: see the class.
            n_timesteps: by default that of the hyperparameters.
            num_envs: by default the hyperparameters' `n_envs`.
            settings: hyperparameters in place of the file's.
            seed: see the class.
            action: see the class.
            intervention_penalty: see the class.
            eval_freq: by default a tenth of the training.
            eval_episodes: see the class.
            threads: see the class.

        Raises:
            ConfigurationError: a value is not allowed.
        """
        known, given = full_id(env_id), dict(settings or {})
        found = {**hyperparameters(algorithm, known), **given}
        steps, copies = found.pop("n_timesteps"), found.pop("n_envs")
        steps, copies = (
            default if chosen is None else chosen
            for chosen, default in ((n_timesteps, steps), (num_envs, copies))
        )
        require_whole("n_timesteps", steps, 1)
        require_whole("num_envs", copies, 1)
        if algorithm == "ppo":
            require_whole("n_steps", found["n_steps"], 1)
            found["batch_size"] = whole_batches(
                found["batch_size"], found["n_steps"] * copies, "batch_size" in given
            )
        if algorithm in OFF_POLICY:
            # The whole training, where Stable-Baselines3 would set aside a million rows.
            found.setdefault("buffer_size", min(_MOST_ROWS, steps * (2 if action == "both" else 1)))
        return cls(
            env_id=known,
            algorithm=algorithm,
            filter=None if filter == UNFILTERED else filter,
            options={k: v for k, v in (options or {}).items() if v is not None},
            knowledge=knowledge,
            n_timesteps=steps,
            num_envs=copies,
            hyperparameters=found,
            seed=seed,
            action=action,
            intervention_penalty=intervention_penalty,
            eval_freq=max(1, steps // PARTS) if eval_freq is None else eval_freq,
            eval_episodes=eval_episodes,
            threads=threads,
        )
