"""The configuration of a training.

Early on a filter that keeps a lower probability lets the agent do more, and so see more of what its
actions lead to. The probability rises linearly to that of the filter; each episode keeps the one
with which it began, so that its guarantee is that of p_0 = min(p(t), max q_0).
"""

from __future__ import annotations

import ast
import json
import math
import numbers
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.training.constraint import (
    COST,
    DEFAULT_VIOLATION_LIMIT,
    UNITS,
    VIOLATION,
    require_at_least_zero,
)
from safe_envs.engine.choice import require_engine
from safe_envs.errors import ConfigurationError, nearest, require_whole, shortened, shown
from safe_envs.filters.conditions.text import names_promise
from safe_envs.registry import full_id
from safe_envs.text import real
from safe_envs.values.promise_filter import PromiseSettings

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


ALGORITHMS = ("ppo", "a2c", "sac", "td3", "ppo-lag", "sac-lag")
OFF_POLICY = ("sac", "td3", "sac-lag")
CONSTRAINED = ("ppo-lag", "sac-lag")
"""Algorithms with a limit on the cost of an episode, on which alone they differ from others."""

ACTIONS = ("executed", "proposed", "both")
"""Actions on which an off-policy algorithm may learn with a filter in the loop; see
`safe_envs.agents.training.replay_buffer`."""

_WHOLE = {
    "n_timesteps": 1,
    "n_envs": 1,
    "n_steps": 1,
    "n_epochs": 1,
    "batch_size": 1,
    "buffer_size": 1,
    "learning_starts": 0,
    "gradient_steps": -1,
    "train_freq": 1,
    "policy_delay": 1,
    "target_update_interval": 1,
    "stats_window_size": 1,
    "sde_sample_freq": -1,
}
"""Hyperparameters that are whole numbers, and the least that each may be."""

_SHARES = ("gamma", "gae_lambda", "tau", "cost_gamma", "cost_gae_lambda")
"""Those from 0 to 1."""

_FROM_ZERO = (
    "learning_rate",
    "ent_coef",
    "vf_coef",
    "noise_std",
    "target_policy_noise",
    "target_noise_clip",
)
_ABOVE_ZERO = ("clip_range", "clip_range_vf", "max_grad_norm", "target_kl")

_POLICY = "MlpPolicy"

_TORCH_NN = ("nn", "th.nn", "torch.nn")
"""How the RL Zoo writes the module of activations."""

_LINEAR = "lin_"
_EXTENDS = "extends"
_SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf")


def hyperparameters(algorithm: str, env_id: str) -> dict[str, Any]:
    """Return the hyperparameters of an env in `hyperparams/ALGORITHM.yml`, or its defaults.

    A file that extends the one of another algorithm adds to what that has for the env.

    Args:
        algorithm: one of `ALGORITHMS`.
        env_id: full id.

    Raises:
        ConfigurationError: the algorithm is unknown.
    """
    if algorithm not in ALGORITHMS:
        raise ConfigurationError(f"--algo {shortened(algorithm)}: {nearest(algorithm, ALGORITHMS)}")
    table = _table(algorithm)
    own = table.get(env_id, table["default"])
    return {**(hyperparameters(table[_EXTENDS], env_id) if _EXTENDS in table else {}), **own}


def _table(algorithm: str) -> dict[str, Any]:
    import yaml

    return yaml.safe_load(
        files("safe_envs.agents.training").joinpath("hyperparams", f"{algorithm}.yml").read_text()
    )


def whole_batches(batch_size: int, rollout: int, asked_for: bool) -> int:
    """Return the largest size of minibatches up to a given one that divides a rollout.

    Args:
        batch_size: wanted, from 2.
        rollout: steps of all envs together.
        asked_for: whether a user chose the size, who is not to get another one.

    Raises:
        ConfigurationError: the size is no whole number from 2, or was asked for and does not divide
            the rollout.
    """
    if isinstance(batch_size, bool) or not isinstance(batch_size, int) or batch_size < 2:
        raise ConfigurationError(f"batch_size = {batch_size!r}; give a whole number from 2")
    fits = next(
        (size for size in range(min(batch_size, rollout), 1, -1) if rollout % size == 0), rollout
    )
    if asked_for and fits != batch_size:
        raise ConfigurationError(
            f"batch_size = {batch_size} does not divide the rollout of n_steps x num_envs ="
            f" {rollout} steps; give {fits}"
        )
    return fits


def checked(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters that are in their ranges, with 1e5 as the whole number that it is.

    What is no number, such as a schedule or None, is left to the algorithm.

    Args:
        settings: by the Zoo's names.

    Raises:
        ConfigurationError: one is out of its range.
    """
    found = dict(settings)
    if found.get("policy", _POLICY) != _POLICY:
        raise ConfigurationError(
            f"policy = {shown(found['policy'])}; the observations of this project's envs are"
            f" vectors, for which there is {_POLICY}"
        )
    for name, least in _WHOLE.items():
        value = found.get(name)
        if value is None or isinstance(value, list | tuple):  # such as [1, episode] of train_freq
            continue
        if isinstance(value, str):
            raise ConfigurationError(f"{name} = {shown(value)}; give a number")
        if isinstance(value, float) and value.is_integer():
            value = found[name] = int(value)
        require_whole(name, value, least)
    ends = {**dict.fromkeys(_SHARES, (0.0, 1.0)), **dict.fromkeys(_FROM_ZERO, (0.0, math.inf))}
    ends |= dict.fromkeys(_ABOVE_ZERO, (math.ulp(0.0), math.inf))
    for name, (low, high) in ends.items():
        value: Any = found.get(name)
        number = isinstance(value, int | float)
        if number and (isinstance(value, bool) or not low <= value <= min(high, 1e300)):
            allowed = "from 0 to 1" if high == 1.0 else "from 0" if low == 0.0 else "above 0"
            raise ConfigurationError(f"{name} = {shown(value)}; give a number {allowed}")
    return found


def python_value(name: str, text: str) -> Any:
    """Return the value of a hyperparameter that the RL Zoo writes in Python, without running it.

    Args:
        name: of the hyperparameter.
        text: literals, dict(NAME=VALUE, ...), and classes of torch.nn such as nn.ReLU.

    Raises:
        ValueError: it holds anything else.
    """
    try:
        return _value_of(ast.parse(text.strip(), mode="eval").body)
    except (
        AttributeError,
        MemoryError,
        RecursionError,
        SyntaxError,
        TypeError,
        ValueError,
    ) as error:
        raise ValueError(
            f"{name} = {shown(text)} is none of the values in Python that are read; give YAML such"
            " as {net_arch: [64, 64]}, or dict(net_arch=[64, 64], activation_fn=nn.ReLU)"
        ) from error


def _value_of(node: ast.expr) -> Any:
    match node:
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=pairs):
            return {pair.arg or _refuse(): _value_of(pair.value) for pair in pairs}
        case ast.Dict(keys=keys, values=values):
            entries = zip(keys, values, strict=True)
            return {_value_of(key or _refuse()): _value_of(value) for key, value in entries}
        case ast.List(elts=parts):
            return [_value_of(part) for part in parts]
        case ast.Tuple(elts=parts):
            return tuple(_value_of(part) for part in parts)
        case ast.Attribute(value=module, attr=name) if ast.unparse(module) in _TORCH_NN:
            from torch import nn

            kind = getattr(nn, name)
            return kind if isinstance(kind, type) and issubclass(kind, nn.Module) else _refuse()
    return ast.literal_eval(node)


def _refuse() -> Any:
    raise ValueError


def scheduled(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings, with texts such as lin_3e-4 as functions of the remaining progress."""
    return {
        k: _linear(k, v) if k in _SCHEDULED and isinstance(v, str) else v
        for k, v in settings.items()
    }


def _linear(name: str, text: str) -> Callable[[float], float]:
    try:
        if not text.startswith(_LINEAR):
            raise ValueError
        first = real(text.removeprefix(_LINEAR))
    except ValueError as error:
        raise ConfigurationError(
            f"{name} = {shown(text)}; give a number, or {_LINEAR}NUMBER for one that falls to 0"
        ) from error
    # Whole rollouts may exceed the training, which makes the remaining progress negative.
    return lambda left: max(left, 0.0) * first


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
        algorithm: one of `safe_envs.agents.training.config.ALGORITHMS`.
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
