"""Runs an evaluation: learns, simulates, and puts together what was found."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from safe_envs.agents.evaluation.attainable import AttainableSafety
from safe_envs.agents.evaluation.bound_averages import BoundAverager
from safe_envs.agents.evaluation.closed_loop_bound import compute_closed_loop
from safe_envs.agents.evaluation.comparison import compare_all
from safe_envs.agents.evaluation.contradiction import judged, upper_ends_of
from safe_envs.agents.evaluation.episode_statistics import EpisodeStatistics
from safe_envs.agents.evaluation.episodes_file import episodes_file
from safe_envs.agents.evaluation.evaluation_data import FilterTiming, Timing
from safe_envs.agents.evaluation.filtered_policy import FilteredPolicy
from safe_envs.agents.evaluation.guarantees import together
from safe_envs.agents.evaluation.identification import describe, seconds_of
from safe_envs.agents.evaluation.kept_episodes import EpisodeSink, KeptEpisodes
from safe_envs.agents.evaluation.players import Player, player_of
from safe_envs.agents.evaluation.repeats import pooled
from safe_envs.agents.evaluation.resolved import conditions_of
from safe_envs.agents.evaluation.results import Evaluation
from safe_envs.agents.evaluation.rows import EvaluationRow
from safe_envs.agents.evaluation.spec import EvaluationSpec, RunSettings
from safe_envs.agents.evaluation.trajectories import Trajectories
from safe_envs.agents.evaluation.views import View, views_of
from safe_envs.agents.evaluation.work_parts import WorkParts
from safe_envs.agents.evaluation.yardstick import best_for, chained


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
        best = self._best()
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
                averagers = [self._averager(of, view) for of in bounded[name]]
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

    def _best(self) -> AttainableSafety | None:
        """Return how safe any policy can be, if it is asked for."""
        return best_for(self._resolved.truth, self._work.part()) if self._spec.best else None

    def _bounded(self, view: View) -> list[FilteredPolicy]:
        """Return what the bounds of a filter are of, for each identification."""
        spec = self._spec
        # The name of an object says nothing.
        policy = spec.policy if isinstance(spec.policy, str) else ""
        given = (spec.knowledge, policy, spec.objective, spec.closed_loop)
        return [FilteredPolicy(view.resolved.truth, parts, *given) for parts in view.filters]

    def _averager(self, of: FilteredPolicy, view: View) -> BoundAverager:
        asked = None if self._spec.bounds else "it was not asked for"
        why_not = view.resolved.target.why_no_bound or asked or view.why_no_bound
        return BoundAverager(of, self._spec.monitoring, why_not)

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
