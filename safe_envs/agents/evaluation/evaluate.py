"""Estimates of how safe a policy is, unfiltered and under filters, on the same episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from safe_envs.agents.evaluation.results import Evaluation
from safe_envs.agents.evaluation.runner import EvaluationRunner
from safe_envs.agents.evaluation.spec import EvaluationSpec, Filter, Progress, RunSettings, listed
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import FilterSpec
from safe_envs.wrappers.learning import LearnedModel


def evaluate(  # noqa: PLR0913  (the friendly form of EvaluationSpec and RunSettings)
    problem: SafetyProblem | str,
    policy: Any = "nominal",
    filters: Sequence[Filter] | Filter | None = None,
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
    filter_spec: FilterSpec | str | None = None,
    learned: Sequence[LearnedModel | Path | str] = (),
    repeats: int = 1,
    monitoring: str = "discrete",
    best: bool = False,
    closed_loop: bool = False,
    estimator: str | None = None,
    belief: float = 0.05,
    observe: str = "estimate",
    jobs: int | None = None,
    progress: Progress | None = None,
    record: bool = False,
    engine: str = "auto",
    keep_episodes: bool | None = None,
    episodes_out: Path | str | None = None,
) -> Evaluation:
    """Estimate the safety of a policy under each filter.

    An episode is safe if every barrier is positive at every control instant, its start included;
    with continuous monitoring between them too, see `BrownianBridge`, which changes neither control
    nor noise. After its first violation an episode's interventions, infeasible steps and effort are
    no longer counted: the conditions mean nothing outside the safe set. Its simulation goes on, and
    its return and minimum h are of the whole episode.

    Each row has two bounds, averaged over the starts: one for the env's own steps, see
    `safe_envs.agents.evaluation.held_input`, and the largest one for continuous control, see
    `safe_envs.wrappers.verification.bounds`, which is proved where a judge proves its hypotheses
    and numbers, and estimated otherwise. A bound that the episodes contradict is withheld: see
    `safe_envs.agents.evaluation.contradiction`.

    Episode i has a seed of its own, `episode_seed(seed, i)`, the same for all filters: it is the
    first episode of an env after `reset(seed=episode_seed(seed, i))`. All but `timing` is the same,
    to the last bit, for every `num_envs` and `jobs`; the engines agree to rounding.

    A filter with a learned model is learned first, with the defaults of its method; with `repeats`
    once for each repeat, and the intervals are over identifications too: see
    `safe_envs.agents.evaluation.statistics.repeated_interval`.

    Args:
        problem: see `EvaluationSpec`, as for all arguments but the last ones.
        policy: a name, a path, an object with `predict`, a class, or a function of a batch.
        filters: texts and conditions, or one of them; by default "none" and the problem's own.
        trust: load a policy's .zip, which runs code that it contains.
        options: arguments of `gym.make` for an id.
        episodes: number for each filter.
        seed: whole number from 0.
        num_envs: how many episodes NumPy simulates side by side.
        knowledge: what the filters know, "model" or "plant".
        objective: of the filters, "nearest" or "clf".
        confidence: of all intervals, between 0 and 1.
        bounds: look for bounds, which takes a search of the safe set for each filter.
        filter_spec: how filters see a third-party env.
        learned: models, or files of `safe-envs identify`, to use in place of learning.
        repeats: number of identifications of what is learned.
        monitoring: where h is checked, "discrete" or "continuous".
        best: whether to compute how safe any policy can be, see
            `safe_envs.agents.evaluation.yardstick`.
        closed_loop: whether to compute certified tables for the bound of the env's own steps, see
            `safe_envs.wrappers.value.closed_loop`.
        estimator: of the state of a measured problem, "kf", "ekf" or "ukf".
        belief: probability of the rows with belief conditions.
        observe: what policies see with an estimator, "estimate" or "measurement".
        jobs: number of processes, or of threads of the compiled engine; the result is the same.
        progress: called with the part of the work that is done, from 0 to 1.
        record: keep trajectories for pictures.
        engine: "auto", "numpy" or "compiled": see `RunSettings`.
        keep_episodes: keep the results of each episode; by default where there are at most
            1,000,000 of them, under all filters. Without it memory does not grow with them.
        episodes_out: FILE.parquet to which they are written while they are simulated.

    Raises:
        ConfigurationError: An argument names something unknown or is out of range.
        RelativeDegreeError: A condition does not suit a barrier.
        NumericalError: A simulation or a condition left the finite numbers.
    """
    spec = EvaluationSpec(
        problem=problem,
        policy=policy,
        filters=listed(filters),
        options=options or {},
        filter_spec=filter_spec,
        learned=learned,
        trust=trust,
        episodes=episodes,
        seed=seed,
        knowledge=knowledge,
        objective=objective,
        confidence=confidence,
        bounds=bounds,
        repeats=repeats,
        monitoring=monitoring,
        best=best,
        closed_loop=closed_loop,
        estimator=estimator,
        belief=belief,
        observe=observe,
    )
    settings = RunSettings(num_envs, jobs, record, progress, engine, keep_episodes, episodes_out)
    return run_evaluation(spec, settings)


def run_evaluation(spec: EvaluationSpec, settings: RunSettings | None = None) -> Evaluation:
    """Run an evaluation; see `evaluate` for what is estimated, and for errors.

    Args:
        spec: all that determines the result.
        settings: how it is run.
    """
    return EvaluationRunner(spec, settings or RunSettings()).run()
