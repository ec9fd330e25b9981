"""How much return a policy and its filter give up for their safety, next to what can be had."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from safe_envs.agents.evaluation.frontier_episodes import FrontierEpisodes
from safe_envs.agents.evaluation.frontier_results import Frontier
from safe_envs.agents.evaluation.resolved import ResolvedEvaluation
from safe_envs.agents.evaluation.spec import UNFILTERED, EvaluationSpec, Progress
from safe_envs.agents.evaluation.work_parts import WorkParts
from safe_envs.errors import SafeEnvsError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.frontier import price_violations
from safe_envs.wrappers.value.priced_values import FrontierSettings


@dataclass(frozen=True)
class FrontierSpec:
    """What is put next to a computed frontier.

    Attributes:
        policies: names, paths or objects for `make_policy`, by the names of their points.
        filters: texts of filters over the nominal controller.
        may_miss: names of policies and filters that are left out, with a note, if they do not suit.
        episodes: number for each point.
        attained: number of episodes of the policies that prices lead to.
        seed: whole number from 0.
        knowledge: what filters know, "model" or "plant".
        trust: load a policy's .zip, which runs code that it contains.
        confidence: of all intervals.
    """

    policies: Mapping[str, Any]
    filters: Sequence[str] = ()
    may_miss: Sequence[str] = ()
    episodes: int = 1000
    attained: int = 500
    seed: int = 0
    knowledge: str = "model"
    trust: bool = False
    confidence: float = 0.95


def frontier(
    problem: SafetyProblem,
    spec: FrontierSpec,
    settings: FrontierSettings | None = None,
    progress: Progress | None = None,
) -> Frontier:
    """Compute what returns can be had at which risk, and simulate policies and filters.

    Args:
        problem: whose plant is controlled.
        spec: what is simulated.
        settings: of the computation.
        progress: called with the part of the work that is done.

    Returns:
        The curve, and points.

    Raises:
        ConfigurationError: The problem has too many coordinates for a grid, or something unknown is
            asked for.
    """
    settings = settings or FrontierSettings()
    # Unknown names are errors before a long computation.
    # A price is that of the true state, whatever is measured of it.
    problem = problem.unmeasured
    wanted, left_out = _resolved(problem, spec)
    parts = WorkParts(progress, 1 + len(wanted) + settings.policies)
    points = []
    values = price_violations(problem, settings, parts.part(1.0))
    measure = FrontierEpisodes(values, spec.seed, spec.confidence)
    for (name, kind), resolved in wanted.items():
        try:
            points.append(measure.evaluated(name, kind, resolved, parts.part(spec.episodes)))
        except SafeEnvsError as error:
            if name not in spec.may_miss:
                raise
            left_out[name] = str(error)
    attained = [
        measure.at_price(i, spec.attained, parts.part(spec.attained))
        for i in range(len(values.of_policies))
    ]
    return Frontier(problem, values, attained, points, left_out, spec.confidence)


def _resolved(
    problem: SafetyProblem, spec: FrontierSpec
) -> tuple[dict[tuple[str, str], ResolvedEvaluation], dict[str, str]]:
    asked = [(name, "policy", policy, UNFILTERED) for name, policy in spec.policies.items()]
    asked += [(name, "filter", "nominal", name) for name in spec.filters]
    found, left_out = {}, {}
    for name, kind, policy, filter_name in asked:
        given = EvaluationSpec(
            problem=problem,
            policy=policy,
            filters=(filter_name,),
            trust=spec.trust,
            episodes=spec.episodes,
            seed=spec.seed,
            knowledge=spec.knowledge,
            confidence=spec.confidence,
            bounds=False,
        )
        try:
            found[name, "best" if name == "best" else kind] = ResolvedEvaluation(given)
        except SafeEnvsError as error:
            if name not in spec.may_miss:
                raise
            left_out[name] = str(error)
    return found, left_out
