"""The configuration of a training.

Early on a filter that keeps a lower probability lets the agent do more, and so see more of what its
actions lead to. The probability rises linearly to that of the filter; each episode keeps the one
with which it began, so that its guarantee is that of p_0 = min(p(t), max q_0).
"""

from __future__ import annotations

import json
import numbers
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.training.constraint import (
    COST,
    DEFAULT_VIOLATION_LIMIT,
    UNITS,
    VIOLATION,
    require_at_least_zero,
)
from safe_envs.agents.training.hyperparameters import (
    ACTIONS,
    CONSTRAINED,
    OFF_POLICY,
    checked,
    hyperparameters,
    whole_batches,
)
from safe_envs.engine.choice import require_engine
from safe_envs.errors import ConfigurationError, nearest, require_whole
from safe_envs.filters.conditions.syntax import names_promise
from safe_envs.registry import full_id
from safe_envs.values.promise_filter import PromiseSettings

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


@dataclass(frozen=True)
class PromiseCurriculum:
    """What probability the episodes that begin after some steps are kept safe with.

    Attributes:
        first: probability at the beginning.
        last: that of the filter.
        steps: over which it rises.
    """

    first: float
    last: float
    steps: float

    @classmethod
    def of(
        cls, first: Any, part: Any, text: str | None, n_timesteps: int
    ) -> PromiseCurriculum | None:
        """Return the curriculum of a training, or None without one.

        Args:
            first: probability at the beginning; None without a curriculum.
            part: of the training over which it rises, up to 1.
            text: of the filter in the loop.
            n_timesteps: of the training.

        Raises:
            ConfigurationError: there is no promise filter, or a number is out of range.
        """
        if not _is_number(part) or not 0.0 < part <= 1.0:
            raise ConfigurationError(
                f"curriculum_part = {part!r}; give the part of the training over which p rises,"
                " above 0 and up to 1"
            )
        if first is None:
            return None
        if text is None or not names_promise(text):
            raise ConfigurationError(
                f"a curriculum on p is for a promise filter in the loop, and the filter is"
                f" {text or 'none'}; give --filter promise:p=0.99, or no --promise-curriculum"
            )
        last = PromiseSettings.of_text(text).probability
        if not _is_number(first) or not 0.0 < first < last:
            raise ConfigurationError(
                f"promise_curriculum = {first!r}; give the probability at the beginning, between 0"
                f" and the filter's {last:g}"
            )
        return cls(float(first), last, part * n_timesteps)

    def at(self, done: int) -> float:
        """Return the probability after some steps of the training."""
        share = min(done / self.steps, 1.0)
        # Rounding is not to exceed what the filter was made for.
        return min((1.0 - share) * self.first + share * self.last, self.last)

    def ask(self, envs: VecEnv, done: int) -> float:
        """Tell the filter of the envs, and return the probability; see `at`."""
        p = self.at(done)
        envs.env_method("ask_promise", p)
        return p


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


_MOST_ROWS = 1_000_000

_PARTS = 10
"""Number of parts of a training, each of which is evaluated, by default."""

_LEAST = {
    "n_timesteps": 1,
    "num_envs": 1,
    "seed": 0,
    "eval_freq": 1,
    "eval_episodes": 1,
    "threads": 1,
}


@dataclass(frozen=True)
class Training:
    """A training, JSON-able; `Training.of` fills in what the hyperparameters say.

    Attributes:
        env_id: full id.
        algorithm: one of `safe_envs.agents.training.hyperparameters.ALGORITHMS`.
        n_timesteps: control periods over all copies of the env.
        num_envs: number of copies.
        hyperparameters: of the algorithm, by the Zoo's names.
        eval_freq: steps between evaluations, at each of which a checkpoint is kept.
        filter: text of the filter in the loop; None for the unfiltered env.
        options: arguments of `gym.make`.
        knowledge: of the filter and the estimator, "model" or "plant".
        estimator: of the state, for envs with a `measurement`; agents see the env's features at
            the estimate, at which the filter decides, too. None for none.
        seed: of everything random.
        action: on which an off-policy algorithm learns; see
            `safe_envs.agents.training.replay_buffer`.
        intervention_penalty: see `safe_envs.agents.training.vec_env.make_sb3_env`.
        promise_curriculum: p of a promise filter with which the training begins, and which rises to
            that of the filter; None for the filter's from the beginning. See
            `safe_envs.agents.training.config`.
        curriculum_part: of the training, over which it rises.
        eval_episodes: of each evaluation.
        threads: of torch and BLAS. Small networks are many times slower on several threads of a
            busy machine.
        engine: of the envs, see `SafeVectorEnv`; "auto" is NumPy for short trainings. Evaluations
            choose theirs by their own length, unless it is "numpy".
        cost_limit: greatest expected number of unsafe steps of an episode, for "ppo-lag" and
            "sac-lag".
        violation_limit: in its place, greatest probability of any unsafe step of an episode; the
            episodes of the training end at the first one.

    Raises:
        ConfigurationError: a value is not allowed.
    """

    env_id: str
    algorithm: str
    n_timesteps: int
    num_envs: int
    hyperparameters: dict[str, Any]
    eval_freq: int
    filter: str | None = None
    options: dict[str, Any] = field(default_factory=dict)
    knowledge: str = "model"
    estimator: str | None = None
    seed: int = 0
    action: str = ACTIONS[0]
    intervention_penalty: float = 0.0
    promise_curriculum: float | None = None
    curriculum_part: float = 0.5
    eval_episodes: int = 200
    threads: int = 1
    engine: str = "auto"
    cost_limit: float | None = None
    violation_limit: float | None = None

    def __post_init__(self) -> None:
        self._require_limits()
        try:
            json.dumps(asdict(self), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ConfigurationError(
                f"a training is kept as JSON: {error}; give numbers, texts, lists and mappings"
            ) from error
        for name, least in _LEAST.items():
            require_whole(name, getattr(self, name), least)
        require_engine(self.engine)
        self.curriculum  # noqa: B018  (which refuses what is out of range)
        if self.seed >= 2**32:
            raise ConfigurationError(f"seed = {self.seed}; torch takes whole numbers below 2^32")
        if self.action not in ACTIONS:
            raise ConfigurationError(f"action = {self.action!r}; {nearest(self.action, ACTIONS)}")
        if self.action != ACTIONS[0] and not self.learns_on_executed:
            raise ConfigurationError(
                f"action = {self.action!r} is for SAC and TD3 with a filter in the loop; leave it"
                " out: others learn on what they propose"
            )
        if self.action == ACTIONS[0] and self.learns_on_executed and self.intervention_penalty:
            raise ConfigurationError(
                "an intervention penalty is of the proposed action, and the executed one, on which"
                " is learned, has none; give --action both or proposed too, or no penalty"
            )

    @property
    def curriculum(self) -> PromiseCurriculum | None:
        """The curriculum on p of the promise filter; None without one."""
        return PromiseCurriculum.of(
            self.promise_curriculum, self.curriculum_part, self.filter, self.n_timesteps
        )

    def _require_limits(self) -> None:
        given = {
            name: limit
            for name, limit in ((COST, self.cost_limit), (VIOLATION, self.violation_limit))
            if limit is not None
        }
        for name, limit in given.items():
            require_at_least_zero(name, limit)
        if given.get(VIOLATION, 0.0) >= 1.0:
            raise ConfigurationError(
                f"violation_limit = {self.violation_limit!r} is a probability, and 1 no limit; give"
                " a number below 1, such as 0.01"
            )
        if self.algorithm not in CONSTRAINED and given:
            raise ConfigurationError(
                f"{self.algorithm} has no {' and no '.join(given)}; leave it out, or choose"
                f" {' or '.join(CONSTRAINED)}"
            )
        if self.algorithm in CONSTRAINED and len(given) != 1:
            raise ConfigurationError(
                f"{self.algorithm} was given {len(given)} limits; give one: cost_limit is on the"
                " number of unsafe steps of an episode, violation_limit on the probability of any"
            )

    @property
    def limit_kind(self) -> str | None:
        """Name of the limit in force; None without one."""
        if self.algorithm not in CONSTRAINED:
            return None
        return COST if self.violation_limit is None else VIOLATION

    @property
    def env_options(self) -> dict[str, Any]:
        """Arguments of the envs of the training, of which those of the evaluations are a part."""
        ends = {"terminate_on_violation": True} if self.limit_kind == VIOLATION else {}
        return {**self.options, **ends}

    @property
    def constraint(self) -> dict[str, float]:
        """Arguments of a constrained algorithm; none for others."""
        kind = self.limit_kind
        return {} if kind is None else {"cost_limit": getattr(self, kind), "cost_unit": UNITS[kind]}

    @property
    def learns_on_executed(self) -> bool:
        """Whether the algorithm can learn on the executed action."""
        return self.algorithm in OFF_POLICY and self.filter is not None

    @classmethod
    def of(
        cls,
        env_id: str,
        algorithm: str,
        *,
        settings: Mapping[str, Any] | None = None,
        n_timesteps: int | None = None,
        num_envs: int | None = None,
        eval_freq: int | None = None,
        **attributes: Any,
    ) -> Training:
        """Return a training with the hyperparameters of `hyperparams`, except for what is given.

        Args:
            env_id: registered id, with or without its namespace.
            algorithm: see the class.
            settings: hyperparameters in place of the file's.
            n_timesteps: by default that of the hyperparameters.
            num_envs: by default the hyperparameters' `n_envs`.
            eval_freq: by default a tenth of the training.
            **attributes: other attributes of the class; options that are None are left out, and the
                filter may be "none". A constrained algorithm without a limit gets
                `safe_envs.agents.training.constraint.DEFAULT_VIOLATION_LIMIT`.

        Raises:
            ConfigurationError: a value is not allowed.
        """
        known, given = full_id(env_id), dict(settings or {})
        found = checked({**hyperparameters(algorithm, known), **given})
        steps, copies = found.pop("n_timesteps"), found.pop("n_envs")
        steps = steps if n_timesteps is None else n_timesteps
        copies = copies if num_envs is None else num_envs
        require_whole("n_timesteps", steps, 1)
        require_whole("num_envs", copies, 1)
        if algorithm in ("ppo", "ppo-lag"):
            found["batch_size"] = whole_batches(
                found["batch_size"], found["n_steps"] * copies, "batch_size" in given
            )
        if algorithm in OFF_POLICY:
            # The whole training, where Stable-Baselines3 would allocate a million rows.
            rows = steps * (2 if attributes.get("action") == "both" else 1)
            found.setdefault("buffer_size", min(_MOST_ROWS, rows))
        if attributes.get("filter") == UNFILTERED:
            attributes["filter"] = None
        limits = [attributes.get(name) for name in (COST, VIOLATION)]
        if algorithm in CONSTRAINED and limits == [None, None]:
            attributes[VIOLATION] = DEFAULT_VIOLATION_LIMIT
        options = attributes.pop("options", None) or {}
        return cls(
            env_id=known,
            algorithm=algorithm,
            n_timesteps=steps,
            num_envs=copies,
            hyperparameters=found,
            eval_freq=max(1, steps // _PARTS) if eval_freq is None else eval_freq,
            options={name: value for name, value in options.items() if value is not None},
            **attributes,
        )
