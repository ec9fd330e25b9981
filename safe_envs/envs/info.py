"""The info contract: which keys an env and a filter report, and of which type.

Every key is present at reset and at every step, with one type throughout: Python scalars and
float64 arrays from a scalar env, arrays with the batch in front from a vector env. No value is NaN.

| key | type | meaning |
|---|---|---|
| `cost` | float | 1.0 where the state is unsafe, 0.0 elsewhere |
| `violation` | bool | some barrier is negative |
| `barrier` | float64 (k,) | value of each barrier, -inf where it has none |
| `h_min` | float | smallest barrier value of the episode so far |
| `episode_cost` | float | sum of the costs of the episode so far |

and with a filter

| key | type | meaning |
|---|---|---|
| `nominal_action` | float64 (m,) | proposed by the policy, or by the goal of a joint QP |
| `safe_action` | float64 (m,) | executed; both in physical units |
| `intervention` | bool | the two differ |
| `filter_active` | bool | a constraint is binding or cannot be met |
| `feasible` | bool | some action within the input bounds meets every constraint |
| `slack` | float | by how much the executed action violates the worst constraint |
| `slacks` | float64 (k,) | the same for each constraint |
| `active_barrier` | int | index of the barrier that caused the intervention, -1 without one |
| `episode_interventions` | int | interventions of the episode so far |
| `episode_infeasible` | int | infeasible steps of the episode so far |
| `input_bounds` | float64 (m, 2) | inputs at the two ends of the action space; not of a joint QP |

and with the promise filter

| key | type | meaning |
|---|---|---|
| `promise` | float | p_k at the state reached: the probability that is still kept, p_0 at reset |

and from an env with the option `delay` or `slew_limit`

| key | type | meaning |
|---|---|---|
| `sent_action` | float64 (m,) | sent to the actuators: the safe action, with a filter |
| `executed_action` | float64 (m,) | executed by the plant; both in physical units |

There a filter's `safe_action` is what it sends, which is executed later.

and from an env with the option `measurement`

| key | type | meaning |
|---|---|---|
| `state` | float64 (n,) | true state, by which all else is judged |
| `received` | bool (k,) | which channels of the sensor reported a sample at this instant |

and with a state estimator

| key | type | meaning |
|---|---|---|
| `estimate` | float64 (n,) | estimate of the state, at which filters above it decide |
| `estimate_covariance` | float64 (n, n) | covariance P of its error, as the estimator believes |
| `innovation` | float64 (k,) | what was measured less what was expected; 0 of lost samples |
| `nees` | float | normalized estimation error squared, e' P^-1 e, with the true error |
| `nees_dof` | int | degrees of freedom of it, the rank of P |
| `nis` | float | normalized innovation squared of the last sample |
| `nis_dof` | int | how many channels that sample had |
| `lost` | int | values of channels that were lost in the episode so far |

and with a filter that has conditions with `belief`

| key | type | meaning |
|---|---|---|
| `belief_barrier` | float64 (k,) | the belief's barriers |

With an estimator, the action and the flags of a filter are those at the estimate; cost, violation
and barrier are those of the true state.

and with a specification, of the trace of the episode so far

| key | type | meaning |
|---|---|---|
| `robustness` | float | how far it is from changing whether it satisfies, positive where it does |
| `satisfied` | bool | it satisfies the specification, if the episode ends here |
| `verdict` | int | 1 where it will, whatever follows, -1 where it will not, 0 where that is open |
| `automaton_state` | int | state of the specification's automaton |

A robustness is -inf or inf where the trace is too short for anything to count.

At reset, before anything is executed, all actions are the point within the input bounds nearest to
0.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, TypedDict, Unpack

import numpy as np

Info = dict[str, Any]

VectorStep = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]
"""What is read off the states of a batch: observation, reward, terminated, truncated and info."""


def safety_info(
    violation: Any, cost: Any, barrier: np.ndarray, h_min: Any, episode_cost: Any
) -> Info:
    """Return what every env reports; see the table above.

    Args:
        violation: whether some barrier is negative.
        cost: 1.0 where it is.
        barrier: value of each barrier.
        h_min: smallest value of the episode.
        episode_cost: sum of the costs of the episode.
    """
    return {
        "cost": cost,
        "violation": violation,
        "barrier": barrier,
        "h_min": h_min,
        "episode_cost": episode_cost,
    }


class FilterInfo(TypedDict):
    """What a filter adds; see the table above."""

    nominal_action: np.ndarray
    safe_action: np.ndarray
    intervention: Any
    filter_active: Any
    feasible: Any
    slack: Any
    slacks: np.ndarray
    active_barrier: Any
    episode_interventions: Any
    episode_infeasible: Any


def filter_info(**values: Unpack[FilterInfo]) -> Info:
    """Return what a filter adds, all of `FilterInfo`."""
    return {**values}


def specification_info(robustness: Any, satisfied: Any, verdict: Any, automaton_state: Any) -> Info:
    """Return what a specification adds; see the table above.

    Args:
        robustness: of the trace so far.
        satisfied: whether it satisfies the specification.
        verdict: whether that is settled.
        automaton_state: after the trace.
    """
    return {
        "robustness": robustness,
        "satisfied": satisfied,
        "verdict": verdict,
        "automaton_state": automaton_state,
    }


def step_cost(cost: Any, violation: Any, episode_cost: Any, before: Any) -> Any:
    """Return what a step cost: by how much the cost of the episode has risen since the last one.

    Where actions are repeated a step is several control periods, and `cost` that of the last one. A
    cost that somebody else wrote into the info stays as it is.

    Args:
        cost: of the info, float64 (...).
        violation: likewise.
        episode_cost: likewise.
        before: `episode_cost` after the last step; NaN where that is not known.
    """
    own = (cost == violation) & (episode_cost >= before)
    return np.where(own, episode_cost - before, cost)


def with_masks(info: Info, present: np.ndarray) -> Info:
    """Add Gymnasium's `_key` masks, which say for which envs of a batch a key was reported.

    Args:
        info: of a batch, changed in place.
        present: the envs that report it, bool (num_envs,), of which each key gets a copy.

    Returns:
        The same object.
    """
    names = _mask_names(tuple(info))
    masks = np.empty((len(names), len(present)), dtype=bool)
    masks[:] = present
    info.update(zip(names, masks, strict=True))
    return info


@lru_cache(maxsize=64)
def _mask_names(keys: tuple[str, ...]) -> tuple[str, ...]:
    return tuple([f"_{key}" for key in keys])
