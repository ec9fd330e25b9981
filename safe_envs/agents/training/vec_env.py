"""The native vector env, with or without a filter, as a `VecEnv` of Stable-Baselines3."""

from __future__ import annotations

import math
import numbers
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, wraps
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.envs.info import Info
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError, require_whole, shown
from safe_envs.filters.conditions.base import Condition
from safe_envs.registry import env_class, full_id
from safe_envs.wrappers.estimator import StateEstimatorVectorWrapper
from safe_envs.wrappers.safety_filter import SafetyFilterVectorWrapper, SafetyFilterWrapper

_OF_ONE_ENV = {
    "observation_space": "single_observation_space",
    "action_space": "single_action_space",
}
_TUPLES_OF_ENVS = ("np_random", "np_random_seed")
_OF_THE_BATCH = ("reset", "step", "step_physical", "close")


_get = dict.get


class LazyInfo(dict[str, Any]):
    """A dict like the scalar env's info, whose entries are made when they are first read.

    Reading a key makes its entry, with the type that the scalar env reports; whatever looks at all
    keys (iteration, `items`, `==`, ...) makes all. A `copy()` stays lazy and keeps `batch` and
    `index`; a pickle or a deep copy is a plain dict of this env's entries. Two are equal if their
    entries are, and arrays if all their elements are.

    Give `json.dumps` a `dict(info)`: its C code takes an info of which no array was read yet for
    empty, and writes "{}".

    Attributes:
        batch: arrays by key, with the batch in front; the infos of a step share them, so read only.
        index: of the env in the batch.

    Args:
        batch: see above; arrays that are not changed any more.
        index: see above.
    """

    __slots__ = ("_left", "batch", "index")

    def __init__(self, batch: Mapping[str, np.ndarray], index: int) -> None:
        self.batch = self._left = batch
        self.index = index

    def __missing__(self, key: str) -> Any:
        values = self._left[key]
        if values.ndim == 1:
            # It is quicker to make a number again than to keep it, which learners read once.
            return values.item(self.index)
        row = self[key] = values[self.index].copy()
        return row

    def __contains__(self, key: object) -> bool:
        return key in self._left or dict.__contains__(self, key)

    def get(self, key: str, default: Any = None) -> Any:
        """Return an entry, or the default if there is none.

        Args:
            key: of the entry.
            default: in its place.
        """
        return self[key] if key in self._left else _get(self, key, default)

    def copy(self) -> LazyInfo:
        """Return an info with the same entries, as lazy as this one."""
        # VecMonitor copies the info of each env that is done: a callback should find `batch` there
        # as well.
        twin = LazyInfo(self.batch, self.index)
        twin._left = self._left
        # What is made already and no more, unlike `twin.update(self)`.
        twin.update(dict.items(self))
        return twin

    __copy__ = copy

    def __reduce__(self) -> tuple[type[dict[str, Any]], tuple[dict[str, Any]]]:
        return dict, (dict(self),)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, dict):
            return NotImplemented
        mine, theirs = dict(self), dict(other)
        return mine.keys() == theirs.keys() and all(
            _same(value, theirs[key]) for key, value in mine.items()
        )

    def __ne__(self, other: object) -> bool:
        equal = self == other
        return not equal

    def make_all(self) -> None:
        """Make the entries that were not read yet."""
        for key in self._left:
            self[key] = self[key]
        # What is deleted from now on stays away.
        self._left = {}


def of_each(infos: Sequence[Any], key: str) -> np.ndarray | list[Any]:
    """Return an entry of every info: an array if they are views of one batch, or a list.

    Args:
        infos: any; those that have `batch`, a dict of arrays over the envs, and `index`, their row
            in them, are read at once, unless the entry of one was written to.
        key: of the entry, for which the list has None where it is missing.
    """
    batch = getattr(infos[0], "batch", None)
    if (
        batch is None
        or key not in batch
        or any(getattr(info, "batch", None) is not batch for info in infos)
        or any(dict.__contains__(info, key) for info in infos)
    ):
        return [info.get(key) for info in infos]
    return batch[key][[info.index for info in infos]]


def of_envs(infos: Any, num_envs: int) -> Sequence[Any]:
    """Return the infos of a step of every env, also those of a vector env of Gymnasium.

    Args:
        infos: a sequence, which is returned; or a mapping of arrays over the envs with their masks.
            There the info of an env whose episode ended is in `final_info`.
        num_envs: number of the envs.
    """
    if not isinstance(infos, Mapping):
        return infos
    rows: list[dict[str, Any]] = [{} for _ in range(num_envs)]
    # Of an ended episode the last step counts, and not the reset after it.
    for part in (infos, infos.get("final_info") or {}):
        for key, values in part.items():
            if not isinstance(values, np.ndarray) or len(values) != num_envs or key[0] == "_":
                continue
            for i in np.flatnonzero(part.get(f"_{key}", np.ones(num_envs, dtype=bool))).tolist():
                rows[i][key] = values[i]
    return rows


def _same(a: Any, b: Any) -> bool:
    return (
        np.array_equal(a, b)
        if isinstance(a, np.ndarray) or isinstance(b, np.ndarray)
        else a is b or a == b
    )


def _after_making_all(name: str) -> Callable[..., Any]:
    of_dict = getattr(dict, name)

    @wraps(of_dict)
    def method(self: LazyInfo, *arguments: Any) -> Any:
        self.make_all()
        return of_dict(self, *arguments)

    return method


_OF_ALL_KEYS = ("keys", "values", "items", "pop", "popitem", "setdefault", "clear")
_OF_ALL_KEYS += (
    "__iter__",
    "__reversed__",
    "__len__",
    "__or__",
    "__ror__",
    "__repr__",
    "__delitem__",
)
for _name in _OF_ALL_KEYS:
    setattr(LazyInfo, _name, _after_making_all(_name))


_TRUNCATED = "TimeLimit.truncated"
_PENALTY = "intervention_penalty"

Filter = Condition | Sequence[Condition] | str | None

_NATIVE = (SafeVectorEnv, SafetyFilterVectorWrapper, StateEstimatorVectorWrapper)


def make_sb3_env(  # noqa: PLR0913  (all but env_id have defaults)
    env_id: str,
    num_envs: int = 8,
    filter: Filter = None,  # noqa: A002  (the word of the whole project)
    *,
    knowledge: str = "model",
    objective: str = "nearest",
    intervention_penalty: float = 0.0,
    seed: int | None = None,
    engine: str = "numpy",
    estimator: str | None = None,
    observe: str = "estimate",
    **options: Any,
) -> SB3VecEnv:
    """Make the `VecEnv` of a registered env for the algorithms of Stable-Baselines3.

    Args:
        env_id: registered id, with or without its namespace.
        num_envs: size of the batch.
        filter: a `Condition` for every barrier, one for each, or their text; None or "none" for the
            unfiltered env.
        knowledge: what the filter knows; see `SafetyFilterWrapper`.
        objective: of the filter; see `SafetyFilterWrapper`.
        intervention_penalty: see `SB3VecEnv`.
        seed: Env i is seeded by seed + i at its first reset; an algorithm's own `seed` comes later
            and replaces it.
        engine: "numpy", "compiled" or "auto"; see `SafeVectorEnv`.
        estimator: of the state, for envs with a `measurement`; see `StateEstimatorWrapper`.
        observe: what the agent sees with an estimator; see there.
        **options: arguments of `gym.make`, also `terminate_on_violation`; those that are None are
            left out.

    Raises:
        ConfigurationError: an id, a filter or an argument is unknown or out of range.
        NotCompilableError: the compiled engine was asked for, and the filter has learned terms
            without a compiled form.
        RelativeDegreeError: the filter does not suit the env's barrier.
    """
    require_whole("num_envs", num_envs, 1)
    if seed is not None:
        require_whole("seed", seed, 0)
    given = {key: value for key, value in options.items() if value is not None}
    # This refuses ids of other projects, whose vector envs take other arguments.
    env_class(env_id)
    env = gym.make_vec(
        full_id(env_id),
        int(num_envs),
        "vector_entry_point",
        autoreset_mode=AutoresetMode.SAME_STEP.value,
        engine=engine,
        **given,
    )
    if estimator is not None:
        env = StateEstimatorVectorWrapper(env, estimator, observe, knowledge)
    if filter is not None and filter != UNFILTERED:
        env = SafetyFilterVectorWrapper(env, filter, knowledge, objective)
    result = SB3VecEnv(env, intervention_penalty)
    if seed is not None:
        result.seed(int(seed))
    return result


class SB3VecEnv(VecEnv):
    """The equivalent of DummyVecEnv over the scalar envs, without a loop over them.

    The infos are `LazyInfo`s: their entries are made when they are read. The info of an env that is
    done describes the last step of its episode, with "terminal_observation";
    "TimeLimit.truncated" tells whether only time ended it. `reset` takes what `set_options` was
    given: the options of `SafeEnv.reset`, in which the envs may differ but for the start's name.

    The algorithms learn on the action that the policy proposed, and on-policy ones have to: they
    see a filter only through the transition, in which all proposals that it corrects to the same
    action look alike. So nothing draws the policy away from proposals that need correction, unless
    a penalty does. Its amount is in the infos as "intervention_penalty", float64 of shape
    (num_envs,) in `batch_info`: zeros at reset, and no such key if c is 0.
    With `replay_buffer_class=FilteredReplayBuffer` SAC, TD3 and DDPG store executed actions, with
    the reward before the penalty; see `safe_envs.agents.training.replay_buffer`.

    Attributes:
        env: the native vector env, with or without a filter.
        batch_info: arrays by key of the last step or reset, with the batch in front; envs that are
            done have those of the last step of their episode.

    Args:
        env: with same-step reset.
        intervention_penalty: c >= 0; the reward is reduced by c |u_safe - u_nominal|, the Euclidean
            distance of `info`'s actions in units of the half widths of the input bounds.

    Raises:
        ConfigurationError: the env is another one, or resets otherwise; or the penalty is out of
            range, or is given without a filter.
    """

    def __init__(self, env: gym.vector.VectorEnv, intervention_penalty: float = 0.0) -> None:
        if not isinstance(env, _NATIVE):
            raise ConfigurationError(
                f"{env} is neither one of this project's vector envs nor a filter over one; use"
                " make_sb3_env"
            )
        if env.metadata["autoreset_mode"] != AutoresetMode.SAME_STEP:
            raise ConfigurationError(
                f"{env} has autoreset_mode {env.metadata['autoreset_mode'].value!r}; make it with"
                " 'SameStep'"
            )
        _require_penalty(intervention_penalty, isinstance(env, SafetyFilterVectorWrapper))
        self.batch_info: Info = {}
        self._penalty = float(intervention_penalty)
        self._half = np.array(center_and_half_width(env.unwrapped.problem)[1])  # pyright: ignore[reportAttributeAccessIssue]
        self._actions = np.empty(0)
        self.env = env
        self._native: SafeVectorEnv = env.unwrapped  # pyright: ignore[reportAttributeAccessIssue]
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        # Stable-Baselines3 lists the modes in which this env can be rendered, Gymnasium those with
        # which it could be made.
        self.metadata = {**env.metadata, "render_modes": self.metadata["render_modes"]}

    def close(self) -> None:
        """Close the native env."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return a picture of each env, None for each where the render mode is not "rgb_array"."""
        if self.render_mode != "rgb_array":
            warnings.warn(
                f"render_mode = {self.render_mode!r}, so that there are no images; make the env"
                " with 'rgb_array'",
                stacklevel=2,
            )
            return [None] * self.num_envs
        pictures: Any = self.env.render()
        return list(pictures)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the filter's wrapper or else of the native env, for each env.

        Each env gets its row of an array with the batch in front, like `state`, or of each array in
        a tuple or list of them, like `executed`, and its own spaces and generator; anything else
        is one object for all.

        Args:
            attr_name: name of the attribute.
            indices: of the envs to ask for.

        Raises:
            AttributeError: neither has it.
        """
        value = self._find(_OF_ONE_ENV.get(attr_name, attr_name))
        if attr_name in _TUPLES_OF_ENVS:
            return [value[i] for i in self._get_indices(indices)]
        return self._for_each(value, indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute for all envs, where it exists or else on the native env.

        Args:
            attr_name: name of the attribute.
            value: new value.
            indices: of all envs.

        Raises:
            AttributeError: it is a property that cannot be set.
            ConfigurationError: some envs are left out, which share their attributes with the
                others.
        """
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ConfigurationError(
                f"{attr_name!r} is shared by all {self.num_envs} envs; set it without indices, or"
                " make another VecEnv"
            )
        holder = next((layer for layer in self._layers() if attr_name in vars(layer)), self._native)
        setattr(holder, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the filter's wrapper or else of the native env, once for the batch.

        Its arguments have the batch in front, and its result is divided as by `get_attr`; from
        `render`, each env gets its picture.

        Args:
            method_name: name of the method.
            *method_args: its arguments.
            indices: of the envs to return a result for.
            **method_kwargs: its keyword arguments.

        Returns:
            The result for each env.

        Raises:
            AttributeError: neither has it.
            ConfigurationError: the method advances the envs, which only this class may do.
        """
        # Gymnasium has these two for single envs only.
        if method_name == "get_wrapper_attr":
            return self.get_attr(*method_args, indices=indices)
        if method_name == "has_wrapper_attr":
            return [self.has_attr(*method_args) for _ in self._get_indices(indices)]
        if method_name in _OF_THE_BATCH:
            raise ConfigurationError(
                f"env_method does not call {method_name!r}, which acts on all envs at once; call"
                " that of the VecEnv"
            )
        result = self._find(method_name)(*method_args, **method_kwargs)
        if method_name == "render" and result is not None:
            return [result[i] for i in self._get_indices(indices)]
        return self._for_each(result, indices)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Return whether each env is in such a wrapper.

        Args:
            wrapper_class: to look for; `SafetyFilterWrapper` includes that of vector envs.
            indices: of the envs to ask for.
        """
        wanted = (
            SafetyFilterVectorWrapper if wrapper_class is SafetyFilterWrapper else wrapper_class
        )
        wrapped = any(isinstance(layer, wanted) for layer in self._layers())
        return [wrapped for _ in self._get_indices(indices)]

    def _layers(self) -> Iterator[gym.vector.VectorEnv]:
        layer: gym.vector.VectorEnv = self.env
        while isinstance(layer, gym.vector.VectorWrapper):
            yield layer
            layer = layer.env
        yield layer

    def _find(self, name: str) -> Any:
        for layer in self._layers():
            try:
                return getattr(layer, name)
            except AttributeError:
                continue
        raise AttributeError(f"neither {self.env} nor what it wraps has an attribute {name!r}")

    def _for_each(self, value: Any, indices: VecEnvIndices) -> list[Any]:
        envs = self._get_indices(indices)
        if self._batched(value):
            return [value[i].copy() for i in envs]
        if isinstance(value, tuple | list) and value and all(map(self._batched, value)):
            kind = tuple if isinstance(value, tuple) else list
            return [kind([v[i].copy() if v.ndim > 1 else v.item(i) for v in value]) for i in envs]
        return [value for _ in envs]

    def _batched(self, value: Any) -> bool:
        return isinstance(value, np.ndarray) and value.shape[:1] == (self.num_envs,)

    def reset(self) -> np.ndarray:
        """Start an episode in every env, with the seeds of `seed` unless they were used.

        Returns:
            Observations, float32 of shape (num_envs, n); the infos are in `reset_infos`.

        Raises:
            ConfigurationError: an option of `set_options` is unknown, or one env has others.
            InvalidInputError: a state or a time is not allowed.
        """
        observation, info = self.env.reset(seed=self._seeds, options=_joined(self._options))
        self._reset_seeds()
        self._reset_options()
        self.batch_info = self._at_rest(info)
        self.reset_infos = self._infos(self.batch_info)
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions in [-1, 1], shape (num_envs, m), for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Hold the actions for one control period; start a new episode in each env that is done.

        Returns:
            Observations, float32 (num_envs, n); rewards, float32 (num_envs,); dones, bool
            (num_envs,); a dict for each env.

        Raises:
            InvalidInputError: the actions have another shape or are not finite.
            NumericalError: the state of an env is no longer finite.
        """
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        dones = terminated | truncated
        ended = dones.nonzero()[0].tolist()
        # In `final_info` the native env leaves whole arrays, which include the envs that go on.
        batch = _arrays(info["final_info"] if ended else info)
        batch[_TRUNCATED] = truncated & ~terminated
        self.batch_info = batch
        if self._penalty:
            distance = np.linalg.norm(
                (batch["safe_action"] - batch["nominal_action"]) / self._half, axis=1
            )
            batch[_PENALTY] = self._penalty * distance
            reward = reward - batch[_PENALTY]
        infos = self._infos(batch)
        if ended:
            restarted = self._at_rest(info)
            for i in ended:
                infos[i]["terminal_observation"] = info["final_obs"][i].copy()
                self.reset_infos[i] = LazyInfo(restarted, i)
        return observation, reward.astype(np.float32), dones, infos

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the state of each episode; see `SafeVectorEnv.snapshot`."""
        return self.env.snapshot()  # pyright: ignore[reportAttributeAccessIssue]

    def restore(self, snapshot: Mapping[str, np.ndarray], seed: int) -> None:
        """Put each episode into the state of a snapshot; see `SafeVectorEnv.restore`.

        Args:
            snapshot: of `snapshot`.
            seed: of the noise and of the starts from then on.
        """
        self.env.restore(snapshot, seed)  # pyright: ignore[reportAttributeAccessIssue]

    def _at_rest(self, info: Info) -> Info:
        """Return the arrays of a reset, with a penalty of zero."""
        batch = _arrays(info)
        if self._penalty:
            batch[_PENALTY] = np.zeros(self.num_envs)
        return batch

    def _infos(self, batch: Info) -> list[dict[str, Any]]:
        return [LazyInfo(batch, i) for i in range(self.num_envs)]


def _require_penalty(penalty: Any, filtered: bool) -> None:
    if not isinstance(penalty, numbers.Real) or not 0.0 <= float(penalty) < math.inf:
        raise ConfigurationError(f"intervention_penalty = {penalty!r}; give a finite number from 0")
    if penalty and not filtered:
        raise ConfigurationError(
            f"intervention_penalty = {penalty!r} without a filter, which alone intervenes; give a"
            " filter, or 0"
        )


def _arrays(info: Info) -> Info:
    """Return the arrays of a vector env's info, without Gymnasium's masks."""
    return {key: info[key] for key in _of_arrays(tuple(info))}


@lru_cache(maxsize=64)
def _of_arrays(keys: tuple[str, ...]) -> tuple[str, ...]:
    return tuple([key for key in keys if not key.startswith(("_", "final_"))])


def _joined(options: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the options of each env as those of a batch."""
    first = options[0]
    if any(each.keys() != first.keys() for each in options) or "reset_mask" in first:
        raise ConfigurationError(
            f"set_options was given {shown(options)}; give each env the same of state, start and t"
        )
    if any(each.get("start") != first.get("start") for each in options):
        raise ConfigurationError(
            f"set_options was given {shown(options)}; all envs start from one distribution"
        )
    return {
        name: value if name == "start" else [each[name] for each in options]
        for name, value in first.items()
    }
