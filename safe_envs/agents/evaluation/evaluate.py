"""Estimates of how safe a policy is, unfiltered and under filters, on the same episodes."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from safe_envs.agents.evaluation.attainable import (
    WorkParts,
    best_for,
    chained,
    progress_of_part,
)
from safe_envs.agents.evaluation.bounds import (
    BoundAverager,
    FilteredPolicy,
    compute_closed_loop,
    continuous_judged,
    judged,
    together,
    upper_ends_of,
)
from safe_envs.agents.evaluation.brownian_bridge import reached_by_noise
from safe_envs.agents.evaluation.compiled_episodes import Player, player_of
from safe_envs.agents.evaluation.episodes import EpisodeStatistics, Trajectories
from safe_envs.agents.evaluation.episodes_file import EpisodeSink, KeptEpisodes, episodes_file
from safe_envs.agents.evaluation.html_table import html_table
from safe_envs.agents.evaluation.identification import describe, pooled, seconds_of
from safe_envs.agents.evaluation.latex_table import latex_table
from safe_envs.agents.evaluation.resolve import View, conditions_of, views_of
from safe_envs.agents.evaluation.results import (
    EvaluationData,
    FilterTiming,
    Timing,
    frame_of,
    row_columns,
)
from safe_envs.agents.evaluation.rows import EvaluationRow
from safe_envs.agents.evaluation.spec import EvaluationSpec, Filter, Progress, RunSettings, listed
from safe_envs.agents.evaluation.statistics import (
    combined_rates,
    compare_all,
    pair_counts,
    paired_difference_interval,
)
from safe_envs.agents.evaluation.table import evaluation_table, setting_lines
from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning.models.base import LearnedModel
from safe_envs.problem.problem import SafetyProblem
from safe_envs.text import markdown_of, plain_markdown, text_of, visible, wrapped
from safe_envs.wrappers.external_env import FilterSpec

_WIDTH = 80
"""Of texts, in characters."""


@dataclass(frozen=True, repr=False)
class Evaluation(EvaluationData):
    """The result of `evaluate`. `print` and notebooks show it as a table."""

    def to_frame(self, episodes: bool = False) -> Any:
        """Return a pandas DataFrame with a row for each filter, or for each episode.

        Args:
            episodes: whether to return the columns of `episode_columns`.

        Raises:
            ConfigurationError: pandas is not installed, or the episodes were not kept: see
                `episodes`.
        """
        return frame_of(self.episode_columns() if episodes else row_columns(self))

    def to_latex(self) -> str:
        """Return the table and the comparisons for a paper, in LaTeX with booktabs."""
        return latex_table(self)

    def to_markdown(self) -> str:
        """Return the setting and the table in Markdown, in parts that fit a page."""
        table = evaluation_table(self)
        tables = [markdown_of(each) for each in table.arranged(_WIDTH)]
        settings = map(plain_markdown, setting_lines(self))
        return "\n\n".join([*settings, tables[0], *table.facts, *tables[1:]])

    def __str__(self) -> str:
        table = evaluation_table(self).short()
        tables = map(text_of, table.arranged(_WIDTH))
        lines = [visible(f"{self.title} | {self.about}", keep="")]
        lines += [part for line in setting_lines(self) for part in wrapped(line, _WIDTH)]
        return "\n\n".join(["\n".join(lines), *tables, *table.facts])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return html_table(self)


class EvaluationRunner:
    """Runs an evaluation, row by row.

    Args:
        spec: all that determines the result.
        settings: how it is run.
    """

    def __init__(self, spec: EvaluationSpec, settings: RunSettings) -> None:
        self._views, self._settings, self._spec = views_of(spec), settings, spec
        # Of one evaluation, or of two, at the true state and at the estimate.
        self._all = list(dict.fromkeys(view.resolved for view in self._views))
        # What is measured, if anything is, tells more of what was asked for.
        self._resolved = next((r for r in self._all if r.estimator), self._all[0])
        often = sum(view.resolved.repeats(view.base) for view in self._views)
        parts = sum(r.parts + r.prepares for r in self._all) + often + bool(spec.best)
        self._work = WorkParts(settings.progress, parts + often * bool(spec.closed_loop))
        self._keeps = settings.keeps(spec.episodes * often)

    def run(self) -> Evaluation:
        """Run all filters and compare them."""
        resolved, spec, settings = self._resolved, self._spec, self._settings
        for each in self._all:
            each.learn(self._work.part)
        best = best_for(resolved.truth, self._work.part()) if spec.best else None
        bounded = {view.name: self._bounded(view) for view in self._views}
        # The bounds find the tables as long as they are in use here.
        tables = [
            compute_closed_loop(of, self._work.part())
            for view in self._views
            for of in bounded[view.name]
            if spec.closed_loop and not view.estimates
        ]
        # Made before the first episode: what is wrong with any of them shows at once.
        players = {
            view.name: [player_of(view.resolved, parts, settings) for parts in view.filters]
            for view in self._views
        }
        config = {**resolved.config(), "episodes": spec.episodes, "repeats": spec.repeats}
        config["filters"] = [view.described for view in self._views]
        recorded = [view.name for view in self._views] if settings.record else ()
        trajectories = {name: Trajectories(resolved.problem, spec.episodes) for name in recorded}
        rows, timings, safe, visited = [], [], {}, {}
        kept = KeptEpisodes() if self._keeps else None
        sinks: list[EpisodeSink] = [kept] if kept else []
        with ExitStack() as opened:
            if settings.episodes_out is not None:
                path = Path(settings.episodes_out)
                sinks.append(opened.enter_context(episodes_file(path, resolved.problem.dt)))
            for view in self._views:
                name = view.name
                asked = None if spec.bounds else "it was not asked for"
                why_not = view.resolved.target.why_no_bound or asked or view.why_no_bound
                averagers = [BoundAverager(of, spec.monitoring, why_not) for of in bounded[name]]
                totals, seconds = self._simulated(
                    name, list(zip(players[name], averagers, strict=True)), trajectories, sinks
                )
                rows.append(self._row(view, totals, averagers, config["policy"]["name"]))
                safe[name] = [each.safe for each in totals]
                visited[name] = [each.visited for each in totals]
                timings.append(self._timing(view, totals, players[name][0], seconds))
        del tables
        best, rows = chained(best, rows)
        return Evaluation(
            resolved.problem,
            spec,
            config,
            rows,
            compare_all(safe, spec.confidence),
            Timing(settings.num_envs, timings),
            trajectories,
            safe,
            visited,
            resolved.learning.models(),
            resolved.is_deterministic,
            kept and kept.joined(),
            best,
        )

    def _bounded(self, view: View) -> list[FilteredPolicy]:
        """Return what the bounds of a filter are of, for each identification."""
        spec = self._spec
        # The name of an object says nothing.
        policy = spec.policy if isinstance(spec.policy, str) else ""
        given = (spec.knowledge, policy, spec.objective, spec.closed_loop)
        return [FilteredPolicy(view.resolved.truth, parts, *given) for parts in view.filters]

    def _simulated(
        self,
        name: str,
        played: Sequence[tuple[Player, BoundAverager]],
        trajectories: Mapping[str, Trajectories],
        sinks: Sequence[EpisodeSink],
    ) -> tuple[list[EpisodeStatistics], float]:
        """Run the episodes under a filter, with each identification, and take the time in s."""
        problem, episodes = self._resolved.problem, self._spec.episodes
        found = []
        # The search for bounds is over: what is timed are episodes.
        begun = time.perf_counter()
        for repeat, (player, averager) in enumerate(played):
            statistics = EpisodeStatistics(problem)
            recorded = trajectories.get(name) if repeat == 0 else None
            for sink in sinks:
                sink.begin(name, repeat)
            for batch in player.play(self._work.part(episodes), recorded):
                averager.add(batch.starts)
                statistics.add(batch)
                for sink in sinks:
                    sink.add(batch.results)
            player.close()
            found.append(statistics)
        return found, time.perf_counter() - begun

    def _row(
        self,
        view: View,
        totals: Sequence[EpisodeStatistics],
        averagers: Sequence[BoundAverager],
        policy: str,
    ) -> EvaluationRow:
        conditions, spec = [conditions_of(each) for each in view.filters], self._spec
        summaries = [each.summary(spec.confidence) for each in totals]
        bounds = [a.summary(t.visited) for a, t in zip(averagers, totals, strict=True)]
        learning = describe(
            conditions,
            [each.safety_rate for each in summaries],
            view.resolved.truth,
            spec.knowledge,
        )
        row = EvaluationRow(
            filter=view.name,
            policy=policy,
            kind=view.kind,
            learning=learning,
            estimation=view.estimation([each.estimation for each in totals], spec.confidence),
            **vars(pooled(summaries, spec.confidence)),
            **vars(together(bounds)),
        )
        return judged(row, *upper_ends_of(row, spec.confidence))

    def _timing(
        self, view: View, totals: Sequence[EpisodeStatistics], player: Player, seconds: float
    ) -> FilterTiming:
        steps = sum(each.steps for each in totals)
        learning = seconds_of([conditions_of(each) for each in view.filters])
        return FilterTiming(
            view.name, seconds, steps, steps / seconds, learning, player.engine, player.jobs
        )


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
    `safe_envs.agents.evaluation.bounds`, and the largest one for continuous control, see
    `safe_envs.proofs.guarantees`, which is proved where a judge proves its hypotheses
    and numbers, and estimated otherwise. A bound that the episodes contradict is withheld: see
    `safe_envs.agents.evaluation.bounds`.

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
            `safe_envs.agents.evaluation.attainable`.
        closed_loop: whether to compute certified tables for the bound of the env's own steps, see
            `safe_envs.values.closed_loop`.
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


DIVISORS = (1, 2, 4)
"""By what the control period is divided."""

TOLERANCE = 0.03
"""The most by which a rate may be off its limit, at either end of the interval, to be called
converged."""

_SURE = 0.999
"""Confidence with which the integration step is found to matter."""


@dataclass(frozen=True)
class RefinementRow:
    """The safety rate under a filter with smaller and smaller control periods, on the same noise.

    Attributes:
        filter: its name.
        safe: number of safe episodes with each period.
        safety_rate: their share.
        ci_low: lower end of its interval.
        ci_high: upper end.
        change: of the rate from dt/2 to dt/4.
        change_low: lower end of the interval of the change.
        change_high: upper end.
        limit: of the rate as the period goes to 0, extrapolated.
        limit_low: lower end of its interval.
        limit_high: upper end.
        error: of the rate with dt, as the distance from the limit.
        error_low: lower end of its interval.
        error_high: upper end.
        verdict: see `refine`.
        withheld: how the rates contradict a bound, which is withheld then.
    """

    filter: str
    safe: list[int]
    safety_rate: list[float]
    ci_low: list[float]
    ci_high: list[float]
    change: float
    change_low: float
    change_high: float
    limit: float
    limit_low: float
    limit_high: float
    error: float
    error_low: float
    error_high: float
    verdict: str
    withheld: str | None


@dataclass(frozen=True)
class Refinement:
    """The result of `refine`.

    Attributes:
        given: the evaluation as it was asked for.
        evaluations: with the control period dt as given, dt/2 and dt/4.
        coupled: whether all three have the integration step of the last one, and the same noise.
        order: power of the period with which the rates go to their limit.
        rows: for each filter its rates with these periods, their limit, and a verdict.
    """

    given: Evaluation
    evaluations: tuple[Evaluation, ...]
    coupled: bool
    order: float
    rows: list[RefinementRow]

    @property
    def periods(self) -> list[float]:
        """The control periods in s."""
        return [evaluation.problem.dt for evaluation in self.evaluations]

    def document(self) -> dict[str, Any]:
        """Return the evaluation with the given dt and its refinement as JSON-able data."""
        rows = [asdict(row) for row in self.rows]
        how = {"coupled": self.coupled, "order": self.order, "tolerance": TOLERANCE}
        return {**self.given.document(), "refinement": {"dt": self.periods, **how, "rows": rows}}


def refine(
    problem: SafetyProblem | str,
    policy: Any = "nominal",
    *,
    progress: Progress | None = None,
    record: bool = False,
    episodes_out: Path | str | None = None,
    **arguments: Any,
) -> Refinement:
    """Evaluate with the control periods dt, dt/2 and dt/4, and extrapolate the safety rate.

    Learned filters are learned once, with the period dt.

    Control and the check of safety go with the period. All three are integrated with the step of
    dt/4, which makes them sample the same path of the noise, so that their rates differ by little
    more than the period makes them differ. What takes one integration step in a period alone, as
    filters with tables do, is evaluated with that, on noise of its own. The horizon is the number
    of whole periods dt.

    Where noise reaches a barrier directly and h is looked at at control instants, the rate goes to
    its limit as sqrt(dt), since a path is seen less often than it crosses; elsewhere as dt. The
    rates p(dt/2) and p(dt/4) give the limit (p(dt/4) - r p(dt/2))/(1 - r), by Richardson, with r =
    2^-1/2 or 1/2. By how much this differs from what p(dt) and p(dt/2) give shows the terms of
    higher order: the interval of the limit has both, that of the episodes and this difference,
    added as squares.

    The verdict on the rate with dt is "converged" where the interval of its distance from the limit
    reaches no further than `TOLERANCE` either way. Elsewhere it is "still changing" where the
    interval does not contain 0, and "not resolved" where it does, so that more episodes are needed.
    It is "integration" where the rate as it was asked for differs, with 99.9 % confidence, from
    that with the smaller integration step. A rate with any of these periods contradicts a bound as
    it does in `evaluate`: then that is withheld, and the verdict "contradicted".

    Args:
        problem: as for `evaluate`.
        policy: as for `evaluate`.
        progress: called with the part of the work of all evaluations that is done, from 0 to 1.
        record: keep trajectories of the evaluation as given for pictures.
        episodes_out: FILE.parquet for the results of each episode of that evaluation.
        **arguments: the others of `evaluate`.

    Returns:
        The evaluations, and the rates with each period.

    Raises:
        ConfigurationError: as for `evaluate`, or dt cannot be divided.
        RelativeDegreeError: a condition does not suit a barrier.
        NumericalError: a simulation or a condition left the finite numbers.

    Source: M. Broadie, P. Glasserman, S. Kou, A continuity correction for discrete barrier options,
        Mathematical Finance 7 (1997) 325-349, for the power 1/2.
    """
    if arguments.get("repeats", 1) != 1:
        raise ConfigurationError(
            "repeats are of the identification and refinement of the period: ask for one of the two"
        )
    if arguments.get("filter_spec") is not None:
        raise ConfigurationError(
            "the control period of a third-party env is its own, and cannot be refined"
        )
    # The work of each evaluation is that of its control periods.
    work = (1, *DIVISORS)
    shares = [
        progress_of_part(progress, sum(work[:i]) / sum(work), part / sum(work))
        for i, part in enumerate(work)
    ]
    of_given = {"record": record, "episodes_out": episodes_out}
    given = evaluate(problem, policy, progress=shares[0], **of_given, **arguments)
    arguments |= {
        "options": None,
        "filters": given.spec.filters or [row.filter for row in given.rows],
        "bounds": False,
        "best": False,
        "closed_loop": False,
        "learned": given.learned,
    }

    def finer(coupled: bool) -> tuple[Evaluation, ...]:
        parts = list(zip(DIVISORS, shares[1:], strict=True))[not coupled :]
        return tuple(
            evaluate(_divided(given.problem, d, coupled), policy, progress=share, **arguments)
            for d, share in parts
        )

    coupled = True
    try:
        evaluations = finer(coupled)
    except ConfigurationError:
        coupled = False
        evaluations = (given, *finer(coupled))
    # The finer ones are nearer to continuous time, of which the bounds are.
    given = replace(given, rows=[_judged(row, evaluations) for row in given.rows])
    order = _order(given)
    rows = [_row(row, given, evaluations, order) for row in given.rows]
    return Refinement(given, evaluations, coupled, order, rows)


def _judged(row: EvaluationRow, finer: Sequence[Evaluation]) -> EvaluationRow:
    """Return a row without continuous bounds that the rate of a finer one contradicts."""
    # What is of the env's own steps is of its own period, and no other one contradicts it.
    for evaluation in finer:
        finer_row = evaluation.row(row.filter)
        row = continuous_judged(row, *upper_ends_of(finer_row, evaluation.spec.confidence))
    return row


def _divided(problem: SafetyProblem, divisor: int, coupled: bool) -> SafetyProblem:
    # Noise is drawn for one integration step after the other: of equal steps it is the same.
    steps = problem.substeps * (DIVISORS[-1] // divisor if coupled else 1)
    # With the whole number of periods as the horizon all end at the same time.
    return replace(problem, dt=problem.dt / divisor, substeps=steps, horizon=problem.duration)


def _order(evaluation: Evaluation) -> float:
    """Return the power of the period with which rates go to their limit."""
    discrete = evaluation.spec.monitoring == "discrete"
    return 0.5 if discrete and any(reached_by_noise(evaluation.problem)) else 1.0


def _row(
    own: EvaluationRow, given: Evaluation, evaluations: tuple[Evaluation, ...], order: float
) -> RefinementRow:
    name, confidence = own.filter, given.spec.confidence
    rows = [evaluation.row(name) for evaluation in evaluations]
    flags = [evaluation.safe[name][0] for evaluation in evaluations]
    changes = paired_difference_interval(*pair_counts(flags[2], flags[1]), confidence)
    ratio = 2.0**-order
    p1, p2, p4 = (row.safety_rate for row in rows)
    higher = abs(p4 - p2 - ratio * (p2 - p1)) / (1.0 - ratio)
    weights = (0.0, -ratio / (1.0 - ratio), 1.0 / (1.0 - ratio))
    limit = _widened(combined_rates(flags, weights, confidence), higher)
    error = _widened(combined_rates(flags, (1.0, -weights[1], -weights[2]), confidence), higher)
    steps = paired_difference_interval(*pair_counts(given.safe[name][0], flags[0]), _SURE)
    word = verdict(*error[1:])
    if not steps[0] <= 0.0 <= steps[1]:
        word = "integration"
    limit, limit_low, limit_high = (min(max(end, 0.0), 1.0) for end in limit)
    return RefinementRow(
        filter=name,
        safe=[row.safe for row in rows],
        safety_rate=[p1, p2, p4],
        ci_low=[row.ci_low for row in rows],
        ci_high=[row.ci_high for row in rows],
        change=p4 - p2,
        change_low=changes[0],
        change_high=changes[1],
        limit=limit,
        limit_low=limit_low,
        limit_high=limit_high,
        error=error[0],
        error_low=error[1],
        error_high=error[2],
        verdict="contradicted" if own.withheld else word,
        withheld=own.withheld,
    )


def _widened(found: tuple[float, float, float], by: float) -> tuple[float, float, float]:
    """Return a value and its interval, with another distance added to it as a square."""
    value, low, high = found
    return value, value - math.hypot(value - low, by), value + math.hypot(high - value, by)


def verdict(low: float, high: float) -> str:
    """Return what the interval (low, high) of the error of a rate means: see `refine`."""
    if max(-low, high) <= TOLERANCE:
        return "converged"
    return "not resolved" if low <= 0.0 <= high else "still changing"
