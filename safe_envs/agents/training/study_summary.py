"""Statistics over the seeds of a study that was read from a file, agent by agent."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.training.seed_statistics import SeedEstimate, over_seeds
from safe_envs.agents.training.study import StudyResult
from safe_envs.agents.training.study_file import Agent
from safe_envs.agents.training.study_job import StudyRow

Estimates = Mapping[str, SeedEstimate | None]


@dataclass(frozen=True)
class AgentSummary:
    """What the agents of a study, trained alike on an env, are like with a filter and without it.

    The estimates are, by name:

    | name | meaning |
    |---|---|
    | `safety` | share of safe episodes, with the filter |
    | `returns` | mean return of an episode, with the filter |
    | `interventions` | share of the steps at which the filter changed the action |
    | `safety_alone` | share of safe episodes, without any filter |
    | `returns_alone` | mean return of an episode, without any filter |
    | `violations` | unsafe steps in the training |
    | `seconds` | processor time of the training |

    Attributes:
        env_id: full id.
        name: of the agents in the study.
        filter: text of the filter of the evaluations; "none" where there is none.
        estimates: interquartile means with intervals over seeds; None for what there is not.
    """

    env_id: str
    name: str
    filter: str
    estimates: Estimates


_FILTERED, _ALONE, _TRAINING = "filtered", "alone", "training"

_QUANTITIES: dict[str, tuple[str, Callable[[StudyRow], float | None]]] = {
    "safety": (_FILTERED, lambda row: row.safety_rate),
    "returns": (_FILTERED, lambda row: row.return_mean),
    "interventions": (_FILTERED, lambda row: row.intervention_rate),
    "safety_alone": (_ALONE, lambda row: row.safety_rate),
    "returns_alone": (_ALONE, lambda row: row.return_mean),
    "violations": (_TRAINING, lambda row: row.violations),
    "seconds": (_TRAINING, lambda row: row.seconds),
}
"""Whether they are of the evaluation with the filter, of that without one, or of the training,
which all evaluations of an agent tell; and where they are in a row."""


def summaries(found: StudyResult, agents: Sequence[Agent], env_id: str) -> list[AgentSummary]:
    """Return the statistics on an env, for each agent and each filter but "none".

    Args:
        found: of the study.
        agents: of its file.
        env_id: full id.
    """
    return _summarised(found, agents, env_id, None)


def differences(
    found: StudyResult, agents: Sequence[Agent], env_id: str, baseline: str
) -> list[AgentSummary]:
    """Return the statistics of what agents have more than others.

    Each agent is compared with that of the baseline that has the same seed, on the same starts and
    noise, and the first filter of the baseline.

    Args:
        found: of the study.
        agents: of its file.
        env_id: full id.
        baseline: name of the agents to compare with; see `StudyFile.require_agent`.
    """
    other = next(agent for agent in agents if agent.name == baseline)
    return _summarised(found, agents, env_id, other)


def _summarised(
    found: StudyResult, agents: Sequence[Agent], env_id: str, baseline: Agent | None
) -> list[AgentSummary]:
    result = []
    for agent in agents:
        for text in _filters(agent) if agent is not baseline else []:
            values = _values(found, agent, env_id, text)
            if baseline is not None:
                other = _values(found, baseline, env_id, _filters(baseline)[0])
                values = {name: _less(values[name], other[name]) for name in values}
            if any(values.values()):
                estimates = {
                    name: over_seeds([list(each.values())]) if each else None
                    for name, each in values.items()
                }
                rows = found.of(env_id, agent.variants[text].name)
                # An env that has no such filter may still have the agents without it.
                name = rows[0].filter if rows else text
                result.append(AgentSummary(env_id, agent.name, name, estimates))
    return result


def _filters(agent: Agent) -> list[str]:
    return [text for text in agent.variants if text != UNFILTERED] or [UNFILTERED]


def _values(
    found: StudyResult, agent: Agent, env_id: str, text: str
) -> dict[str, dict[int, float]]:
    """Return the values of each quantity by the number of the training."""
    by_text = {key: found.of(env_id, each.name) for key, each in agent.variants.items()}
    rows = {
        _FILTERED: by_text[text],
        _ALONE: by_text.get(UNFILTERED, []),
        _TRAINING: [row for of_text in by_text.values() for row in of_text],
    }
    return {
        name: {row.k: float(v) for row in rows[of] if (v := value(row)) is not None}
        for name, (of, value) in _QUANTITIES.items()
    }


def _less(values: dict[int, float], others: dict[int, float]) -> dict[int, float]:
    return {k: values[k] - others[k] for k in values.keys() & others.keys()}
