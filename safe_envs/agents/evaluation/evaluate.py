"""How safe a policy is, bare and under filters: the same episodes for every filter, batched."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge, require_monitoring
from safe_envs.agents.evaluation.comparison import Comparison, SafetyBits, compare_all
from safe_envs.agents.evaluation.contradiction import judged
from safe_envs.agents.evaluation.guarantees import GuaranteeAverager, together
from safe_envs.agents.evaluation.identification import describe, seconds_of
from safe_envs.agents.evaluation.parallel_rollout import play_in_processes
from safe_envs.agents.evaluation.repeats import pooled
from safe_envs.agents.evaluation.rollout import (
    EpisodeStatistics,
    Progress,
    Recorder,
    Row,
    play,
    totals_of,
)
from safe_envs.agents.evaluation.spec import BARE, EvaluationSpec, Work
from safe_envs.agents.evaluation.statistics import require_confidence
from safe_envs.agents.evaluation.visited_states import Seen
from safe_envs.agents.jobs.fingerprint import package_versions
from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import FilterSpec
from safe_envs.wrappers.learning import LearnedModel

__all__ = ["BARE", "Evaluation", "evaluate"]


@dataclass(frozen=True)
class Evaluation:
    """The answer of `evaluate`.

    Attributes:
        problem: what was simulated.
        config: everything needed to run it again, as JSON.
        rows: statistics, one row for each filter.
        comparisons: of every two rows, by which of the same episodes were safe.
        timing: the only part that depends on the machine and on `num_envs`.
        recorders: trajectories for each filter, if asked for.
        flags: which episodes were safe, for each filter, with each identification of what it rests
            on.
        seen: states of the episodes that say something against a bound, for each filter and
            identification.
        learned: what the first identifications of the filters rest on.
        repeats: whether nothing is random, so that all episodes are one and the same.
    """

    problem: SafetyProblem
    config: dict[str, Any]
    rows: list[Row]
    comparisons: list[Comparison]
    timing: dict[str, Any]
    recorders: dict[str, Recorder]
    flags: dict[str, list[SafetyBits]]
    seen: dict[str, list[Seen]]
    learned: list[LearnedModel]
    repeats: bool

    @property
    def title(self) -> str:
        """How results call what was evaluated."""
        return self.config["title"]

    def document(self) -> dict[str, Any]:
        """The whole as JSON-able data."""
        return {
            "config": self.config,
            "versions": package_versions(),
            "rows": self.rows,
            "comparisons": self.comparisons,
            "timing": self.timing,
        }


def evaluate(
    problem: SafetyProblem | str,
    policy: Any = "nominal",
    filters: Sequence[str] | str | None = None,
    *,
    trust: bool = False,
    options: Mapping[str, Any] | None = None,
    episodes: int = 1000,
    seed: int = 0,
    num_envs: int = 1024,
    knowledge: str = "model",
    objective: str = "nearest",
    confidence: float = 0.95,
    bounds: bool = True,
    spec: FilterSpec | str | None = None,
    learned: Sequence[LearnedModel | Path | str] = (),
    repeats: int = 1,
    monitoring: str = "discrete",
    jobs: int = 1,
    progress: Progress | None = None,
    record: bool = False,
) -> Evaluation:
    """Estimate the safety of a policy under each filter.

    An episode is safe if every barrier is positive at every control instant, its start included;
    with continuous monitoring between them too, see
    `safe_envs.agents.evaluation.brownian_bridge.BrownianBridge`, which changes neither control nor
    noise. After its first violation an episode's interventions, infeasible steps and effort are no
    longer counted: the conditions mean nothing outside the safe set. Its simulation goes on, and
    its return and smallest h are of the whole episode.

    Beside the rate stands the largest bound that is estimated for the filter, on average over the
    starts: see `safe_envs.wrappers.verification.bounds`. It is of continuous time and rests on
    suprema from a search. What the episodes contradict is withheld: see
    `safe_envs.agents.evaluation.contradiction`.

    Episode i is seeded by its own child of `seed`, the same for all filters; all but `timing` is
    the same, to the last bit, for every `num_envs`.

    What a filter rests on that is learned, is learned first, with the defaults of its method. With
    `repeats` that is done anew for each repeat, and the intervals are over identifications too: see
    `safe_envs.agents.evaluation.statistics.repeated_interval`.

    Args:
        problem: what to simulate, or the id of a registered env; with a spec, the id of any env
            that Gymnasium knows.
        policy: a name or a path for `make_policy`, or anything with Stable-Baselines3's `predict`.
        filters: texts for `parse_conditions`, or one, and "none" for the bare env; by default that
            and the problem's own.
        trust: load a policy's .zip, which runs code that it contains.
        options: arguments of `gym.make` for an id.
        episodes: number for each filter.
        seed: whole number from 0.
        num_envs: how many episodes to simulate side by side.
        knowledge: what the filters know, "model" or "plant"; those that correct the model start
            from it in any case.
        objective: of the filters, "nearest" to the policy's action or "clf": see
            `SafetyFilter.for_problem`.
        confidence: of all intervals, between 0 and 1.
        bounds: look for bounds, which takes a search of the safe set for each filter.
        spec: how filters see an env of somebody else, or FILE.py:NAME of that. There `problem` is
            the model that filters believe, and episodes are simulated one by one.
        learned: models, or files of `safe-envs identify`, to use in place of learning.
        repeats: number of identifications of what is learned, from the seed and from children of
            it; 1 where nothing is.
        monitoring: when h is looked at: "discrete" for control instants, "continuous" for between
            them too.
        jobs: in how many processes to simulate; the answer is the same.
        progress: told the part of the work that is done, from 0 to 1.
        record: keep trajectories for pictures.

    Raises:
        ConfigurationError: an argument names something unknown or is out of range.
        RelativeDegreeError: a condition does not suit a barrier.
        NumericalError: a simulation or a condition left the finite numbers.
    """
    for name, value, least in (
        ("episodes", episodes, 1),
        ("num_envs", num_envs, 1),
        ("jobs", jobs, 1),
    ):
        require_whole(name, value, least)
    if jobs > 1 and record:
        raise ConfigurationError(
            f"jobs = {jobs}: trajectories for pictures are kept in one process; leave jobs out, or"
            " the picture"
        )
    require_confidence(confidence)
    require_monitoring(monitoring)
    setting = EvaluationSpec(
        problem,
        policy,
        filters,
        trust=trust,
        options=options,
        seed=seed,
        knowledge=knowledge,
        objective=objective,
        spec=spec,
        learned=learned,
        repeats=repeats,
    )
    simulated, world, names, learning = (
        setting.simulated,
        setting.problem,
        setting.names,
        setting.learning,
    )
    if monitoring == "continuous" and simulated.spec is not None:
        raise ConfigurationError(
            "monitoring = 'continuous': how an env of somebody else moves between its steps is not"
            " known; use 'discrete'"
        )
    work = Work(progress, len(learning.missing()) + sum(learning.repeats(name) for name in names))
    setting.learn(work.part)
    filters_of = setting.filters
    # Made before the first episode: what is wrong with any of them shows at once.
    envs = {
        name: [setting.env(conditions, min(num_envs, episodes)) for conditions in each]
        for name, each in filters_of.items()
    }
    config = {
        **setting.config(),
        "episodes": episodes,
        "seed": seed,
        "repeats": repeats,
        "confidence": confidence,
        "monitoring": monitoring,
    }
    bridge = BrownianBridge(world) if monitoring == "continuous" else None
    why_not = simulated.why_no_bound or (None if bounds else "it was not asked for")
    rows, speeds, flags, seen = [], [], {}, {}
    recorders = (
        {name: Recorder(world.steps, world.plant.n, episodes) for name in names} if record else {}
    )
    for name in names:
        promised = [
            GuaranteeAverager(conditions, world, knowledge, why_not)
            for conditions in filters_of[name]
        ]
        begun = time.perf_counter()
        totals = [
            totals_of(
                world,
                (
                    play_in_processes(
                        setting,
                        filters_of[name][r],
                        episodes,
                        seed,
                        num_envs,
                        jobs,
                        bridge is not None,
                        work.part(episodes),
                    )
                    if jobs > 1
                    else play(
                        env,
                        setting.actor,
                        range(episodes),
                        seed,
                        work.part(episodes),
                        recorders.get(name) if r == 0 else None,
                        bridge,
                    )
                ),
                promised[r].add,
            )
            for r, env in enumerate(envs[name])
        ]
        for env in envs[name]:
            env.close()
        speeds.append(
            {
                **_speed(name, totals, time.perf_counter() - begun),
                "learning_seconds": seconds_of(filters_of[name]),
            }
        )
        found = pooled([each.row(confidence) for each in totals], confidence)
        rows.append(
            {
                "filter": name,
                "policy": config["policy"]["name"],
                **found,
                **judged(
                    together(
                        [
                            promise.row(each.seen)
                            for promise, each in zip(promised, totals, strict=True)
                        ]
                    ),
                    found["ci_high"],
                ),
                "learning": describe(
                    filters_of[name],
                    [each.safe / each.episodes for each in totals],
                    world,
                    knowledge,
                ),
            }
        )
        flags[name], seen[name] = [each.flags for each in totals], [each.seen for each in totals]
    timing = {"num_envs": num_envs, "rows": speeds}
    comparisons = compare_all(flags, confidence)
    return Evaluation(
        world,
        config,
        rows,
        comparisons,
        timing,
        recorders,
        flags,
        seen,
        learning.models(),
        simulated.is_deterministic(setting.actor),
    )


def _speed(name: str, totals: Sequence[EpisodeStatistics], seconds: float) -> dict[str, Any]:
    steps = sum(each.steps for each in totals)
    return {"filter": name, "seconds": seconds, "steps": steps, "steps_per_second": steps / seconds}
