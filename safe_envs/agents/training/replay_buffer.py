"""Replay buffers for learning with a filter in the loop, on executed or on proposed actions.

A policy proposes a, a filter executes u(a). Stable-Baselines3 stores a: `_store_transition` knows
of no other action.

Off-policy (SAC, TD3, DDPG) the default here is the executed action. Any (state, action, reward,
next state) that the system produced is a sample for Q, whoever chose the action, and what produced
the next state is u: so Q learns what was done. With the proposals Q is that of the filtered env
instead, constant along all actions that the filter maps to one. With the executed actions alone Q
is extrapolated at actions that the filter never lets through; "both" also fills those in,
consistently, as the filter passes its own answer on unchanged.

A penalty on interventions (`SB3VecEnv`) is a function of the proposal: r - c |u - a| belongs to
(s, a). Stored with u it would be noise, as the same u follows from many a. So the rewards go as
with Krasowski et al.: the penalised r to (s, a), the env's own r to (s, u), which the buffers get
by adding the infos' "intervention_penalty" back (up to the rounding of rewards to single
precision), also in n-step returns. A penalty thus has no effect with "executed"; `Training` refuses
that.

On-policy (PPO, A2C) the proposal has to stay, and no buffer for it is offered. The loss weights a
sample by pi_new(a | s) / pi_old(a | s) with the stored log-probability of the a that was sampled.
With u in its place the ratio is not 1 before the first update, and u has no density under pi that
could be stored: all proposals beyond a constraint are mapped onto it. The filter is part of the
env there. Stable-Baselines3 treats its own clipping to the action space in the same way:
`OnPolicyAlgorithm.collect_rollouts` sends the clipped action to the env and stores the sampled one.

Sources: Krasowski et al., "Provably Safe Reinforcement Learning: Conceptual Analysis, Survey, and
    Benchmarking", 2022, arXiv:2205.06750, on the learning tuples; Gros, Zanon, Bemporad, "Safe
    Reinforcement Learning via Projection on a Safe Set: How to Achieve Optimality?", 2020,
    arXiv:2004.00915, on the effect of a projection on Q-learning and policy gradients; Markgraf et
    al., "Safe Reinforcement Learning using Action Projection: Safeguard the Policy or the
    Environment?", 2025, arXiv:2509.12833, on actions that are mapped to one; Schulman et al.,
    "Proximal Policy Optimization Algorithms", 2017, arXiv:1707.06347, on the ratio.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from safe_envs.agents.training.hyperparameters import ACTIONS
from safe_envs.agents.training.vec_env import of_each, of_envs
from safe_envs.errors import ConfigurationError, nearest, require_whole
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.filter_layers import ends_of

_ROUNDING = 1e-6
"""How far beyond [-1, 1] rounding may move an action on the input bounds."""

_ALIKE = 1e-5
"""How far apart the same proposal may be in [-1, 1], once it was rounded to single precision."""


def executed_actions(
    proposed: np.ndarray, infos: Sequence[Any], bounds: np.ndarray | None
) -> np.ndarray:
    """Return executed actions in [-1, 1], or proposals without a filter, shape (n_envs, m).

    Args:
        proposed: in [-1, 1], shape (n_envs, m).
        infos: of the step, one for each env.
        bounds: inputs at the ends of the action space, shape (m, 2), where the infos do not say
            them, or not those of the learner; None if unknown.

    Raises:
        ConfigurationError: an executed action is out of the input bounds, or these are unknown.
    """
    names = "safe_action", "nominal_action", "input_bounds"
    reported = [of_each(infos, name) for name in names]
    rows: Any = slice(None)
    if isinstance(reported[0], list):
        rows = [i for i, u in enumerate(reported[0]) if u is not None]
        if not rows:
            return proposed
    actions = proposed.astype(np.float64)
    safe, nominal, told = (_rows_of(values, rows) for values in reported)
    actions[rows] = _between(safe, _fitting(actions[rows], nominal, told, bounds))
    return actions


def _fitting(
    proposed: np.ndarray,
    nominal: np.ndarray | None,
    told: np.ndarray | None,
    bounds: np.ndarray | None,
) -> np.ndarray:
    """Return the inputs at the ends of the learner's action space, shape (rows, m, 2)."""
    known = [each for each in (told, bounds) if each is not None]
    if told is not None and nominal is not None:
        known = [each for each in known if _stand_for(proposed, nominal, each)]
    if not known:
        raise ConfigurationError(
            "the env is filtered, and a wrapper around the filter changes the actions, or the"
            " map of the actions is no straight line, so that the executed ones are unknown in"
            " units of the action space; put the filter around that wrapper, or give"
            " replay_buffer_kwargs={'input_bounds': [(low, high), ...]}: the inputs at its ends. A"
            " loop of your own adds actions in [-1, 1], not in the units of another action space"
        )
    return known[0]


def _rows_of(values: Any, rows: Any) -> Any:
    """Return the entries of some infos as an array; None where one of them has none."""
    if isinstance(values, np.ndarray):
        return values[rows]
    picked = [values[i] for i in (range(len(values)) if isinstance(rows, slice) else rows)]
    return None if any(each is None for each in picked) else np.array(picked)


def _between(inputs: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return inputs (rows, m) in [-1, 1], where bounds (m, 2) or (rows, m, 2) are the ends."""
    center, half = _middle(bounds)
    actions = (inputs - center) / half
    clipped = np.clip(actions, -1.0, 1.0)
    if not (np.abs(actions - clipped) <= _ROUNDING).all():
        low, high = np.sort(bounds.reshape(-1, *bounds.shape[-2:])[0], axis=-1).T
        raise ConfigurationError(
            f"the executed actions {inputs.tolist()} are not between {low.tolist()} and"
            f" {high.tolist()}; give the input bounds of the env's problem, as"
            " replay_options(env) does"
        )
    return clipped


def _stand_for(proposed: np.ndarray, nominal: np.ndarray, bounds: np.ndarray) -> bool:
    """Return whether proposals in [-1, 1] between bounds are the inputs that a filter got."""
    center, half = _middle(bounds)
    alike = np.abs(center + half * np.clip(proposed, -1.0, 1.0) - nominal) <= _ALIKE * np.abs(half)
    # A vector env that only starts an episode ignores the proposal, and reports an input at rest.
    return bool((alike | (nominal == np.clip(0.0, bounds.min(-1), bounds.max(-1)))).all())


def _middle(bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Physical input = middle + half the width * action."""
    return bounds.mean(axis=-1), 0.5 * (bounds[..., 1] - bounds[..., 0])


def bounds_of(input_bounds: Sequence[Sequence[float]], inputs: int) -> np.ndarray:
    """Return (low, high) of each input, shape (m, 2).

    Args:
        input_bounds: as pairs.
        inputs: m.

    Raises:
        ConfigurationError: it is something else.
    """
    try:
        pairs = np.array(input_bounds, dtype=np.float64)
    except (TypeError, ValueError):
        pairs = np.empty(0)
    if (
        pairs.shape != (inputs, 2)
        or not np.all(np.isfinite(pairs))
        or np.any(pairs[:, 0] >= pairs[:, 1])
    ):
        raise ConfigurationError(
            f"input_bounds = {input_bounds!r}; give a finite (low, high) with low < high for each"
            f" of the {inputs} inputs"
        )
    return pairs


class FilteredReplayBuffer(ReplayBuffer):
    """A replay buffer that stores what a filter executed.

    Example: `SAC("MlpPolicy", env, replay_buffer_class=FilteredReplayBuffer)`, where the filter is
    the outermost wrapper that changes actions. Without this class SAC, TD3 and DDPG store what they
    proposed.

    It takes `info["safe_action"]`, which is physical, to [-1, 1] in double precision, between the
    inputs that `info["input_bounds"]` has at the ends of the action space: so the env of a learner
    may be exchanged. An env that reports no safe action has no filter: its proposal is stored, as
    Stable-Baselines3 does. With "both" each step fills two rows, so that the buffer holds half as
    many steps; also where the two actions are equal, as one row holds a step of all envs: so each
    step has the same weight for any number of envs. A row of the executed action has the env's own
    reward, to which `info["intervention_penalty"]`, if there is one, is added back.

    For observations with keys, as of `MultiInputPolicy`, it makes a `FilteredDictReplayBuffer`.

    Args:
        args: those of `ReplayBuffer`.
        input_bounds: physical (low, high) of each input at the ends of the action space, where the
            infos and the action space do not know them, as behind a wrapper that halves the
            actions.
        action: "executed", "proposed" or "both".
        kwargs: those of `ReplayBuffer`.

    Raises:
        ConfigurationError: an argument is not allowed, or "both" is combined with
            `optimize_memory_usage`.
    """

    _bounds: np.ndarray | None = None

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        """Make a buffer for the kind of the observations."""
        space = args[1] if len(args) > 1 else kwargs.get("observation_space")
        if not isinstance(space, gym.spaces.Dict) or issubclass(cls, DictReplayBuffer):
            return super().__new__(cls)
        if cls is not FilteredReplayBuffer:
            raise ConfigurationError(
                f"{cls.__name__} stores observations of one array, and these have keys; derive a"
                " buffer for them from FilteredDictReplayBuffer, or flatten them by"
                " gymnasium.wrappers.FlattenObservation"
            )
        kind: Any = FilteredDictReplayBuffer
        return super().__new__(kind)

    def __init__(
        self,
        *args: Any,
        input_bounds: Sequence[Sequence[float]] | None = None,
        action: str = "executed",
        **kwargs: Any,
    ) -> None:
        if action not in ACTIONS:
            raise ConfigurationError(f"action = {action!r}; {nearest(str(action), ACTIONS)}")
        super().__init__(*args, **kwargs)
        if action == "both" and self.optimize_memory_usage:
            # There a row's next observation is the observation of the row after it, here the twin.
            raise ConfigurationError(
                "action = 'both' needs a next observation in each row; set"
                " optimize_memory_usage=False"
            )
        self.action = action
        ends = ends_of(self.action_space)
        if input_bounds is not None:
            self._bounds = bounds_of(input_bounds, self.action_dim)
        elif ends is not None:  # else there may be no filter, and nothing to scale
            self._bounds = np.stack(ends, axis=-1)

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: Any,
    ) -> None:
        """Store one step of every env.

        Args:
            obs: shape (n_envs, features), or a mapping of such arrays.
            next_obs: likewise, the terminal one where an episode ended.
            action: proposals in [-1, 1], shape (n_envs, m).
            reward: less the penalty on interventions, if there is one, shape (n_envs,).
            done: whether the episode ended, shape (n_envs,). With the infos of a vector env, which
                do not say where only time ended it, whether it was terminated.
            infos: of the step just taken, not of the reset after it: one for each env, or those of
                a vector env of Gymnasium.

        Raises:
            ConfigurationError: an executed action is out of the input bounds, or these are unknown.
        """
        each: Any = of_envs(infos, self.n_envs)
        if self.action != "proposed":
            proposed = action.reshape(self.n_envs, self.action_dim)
            executed = executed_actions(proposed, each, self._bounds)
            own = _own_reward(reward, each)
            super().add(obs, next_obs, executed, own, done, each)
        if self.action != "executed":
            super().add(obs, next_obs, action, reward, done, each)


class FilteredDictReplayBuffer(FilteredReplayBuffer, DictReplayBuffer):
    """A `FilteredReplayBuffer` for observations with keys."""


class FilteredNStepReplayBuffer(FilteredReplayBuffer, NStepReplayBuffer):
    """A `FilteredReplayBuffer` for n-step returns, with the action of the first step.

    Its further arguments are `n_steps` and `gamma`.

    Raises:
        ConfigurationError: as for `FilteredReplayBuffer`, or `action` is "both": consecutive
            rows have to be consecutive steps.
    """

    def __init__(self, *args: Any, action: str = "executed", **kwargs: Any) -> None:
        if action == "both":
            raise ConfigurationError(
                "action = 'both' stores each step twice, which n-step returns would count twice;"
                " set n_steps=1"
            )
        super().__init__(*args, action=action, **kwargs)


def replay_options(
    source: SafetyProblem | gym.Env[Any, Any] | gym.vector.VectorEnv | VecEnv,
    action: str = "executed",
    n_steps: int = 1,
    gamma: float = 0.99,
) -> dict[str, Any]:
    """Return the arguments of SAC, TD3 or DDPG with which they learn on an action.

    Example: `SAC("MlpPolicy", env, **replay_options(env, "both"))`.

    Args:
        source: the problem, or an env of it with or without filter.
        action: "executed", "proposed" or "both".
        n_steps: of the returns. Do not give it to the algorithm, which ignores it if it has a
            buffer class.
        gamma: discount. With `n_steps` > 1 the buffer needs it too, and it is among the returned
            arguments.

    Raises:
        ConfigurationError: the env is not one of this project, its parts differ in their boxes, or
            an argument is not allowed.
    """
    require_whole("n_steps", n_steps, 1)
    settings = {"input_bounds": _box_of(source), "action": action}
    if n_steps == 1:
        return {"replay_buffer_class": FilteredReplayBuffer, "replay_buffer_kwargs": settings}
    settings |= {"n_steps": n_steps, "gamma": gamma}
    return {
        "replay_buffer_class": FilteredNStepReplayBuffer,
        "replay_buffer_kwargs": settings,
        "gamma": gamma,
    }


def _own_reward(reward: np.ndarray, infos: Sequence[Any]) -> np.ndarray:
    """Return the rewards before a penalty on interventions, shape (n_envs,)."""
    penalties = of_each(infos, "intervention_penalty")
    if isinstance(penalties, list):
        penalties = np.array([penalty or 0.0 for penalty in penalties])
    return reward + penalties


def _box_of(source: Any) -> tuple[tuple[float, float], ...]:
    if isinstance(source, SafetyProblem):
        return source.input_bounds
    try:
        problems = (
            source.get_attr("problem") if isinstance(source, VecEnv) else [source.unwrapped.problem]
        )
        boxes = {problem.input_bounds for problem in problems}
    except AttributeError as error:
        raise ConfigurationError(
            f"{source} is not one of this project's envs; give one, or a SafetyProblem"
        ) from error
    if len(boxes) > 1:
        raise ConfigurationError(
            f"the envs have different input bounds {sorted(boxes)}; one learner needs the"
            " same for all of them"
        )
    return boxes.pop()
