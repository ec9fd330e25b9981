"""`safe-envs evaluate`: the safety of a policy, unfiltered and under filters."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safe_envs.errors import ConfigurationError
from safe_envs.scripts.options import evaluation_options, text_options
from safe_envs.scripts.options import evaluation_options as of
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import progress_bar, stdout, write_result, write_text_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env

if TYPE_CHECKING:
    from safe_envs.agents.evaluation.evaluate import Evaluation


@with_env
def evaluate(
    env: EnvOptions,
    filter_spec: of.FilterSpecPlace = None,
    filters: of.Filters = None,
    policy: of.Policy = "nominal",
    trust: text_options.Trust = False,
    episodes: of.Episodes = None,
    seed: text_options.Seed = 0,
    knowledge: text_options.Knowledge = "model",
    objective: of.Objective = "nearest",
    estimator: of.Estimator = None,
    belief: of.Belief = 0.05,
    observe: of.Observe = "estimate",
    learned: of.Learned = None,
    repeats: of.Repeats = 1,
    confidence: of.Confidence = 0.95,
    refine: of.Refine = False,
    monitoring: of.Monitoring = "discrete",
    bounds: of.Bounds = True,
    best: of.Best = False,
    closed_loop: of.ClosedLoop = False,
    rare: of.Rare = False,
    particles: of.Particles = None,
    repetitions: of.Repetitions = None,
    num_envs: of.NumEnvs = None,
    jobs: of.Jobs = None,
    engine: text_options.Engine = "auto",
    json: of.JsonOut = None,
    latex: of.Latex = None,
    episodes_out: of.EpisodesOut = None,
    plot: of.Plot = None,
    timing: of.Timing = False,
    size: evaluation_options.Size = None,
) -> None:
    """Print the safety rate of a policy under each filter, and compare the filters in pairs.

    An episode is safe if every barrier is positive at every control instant, or with --monitoring
    continuous between them too. After an episode's first violation its interventions, infeasible
    steps and effort are no longer counted. All filters see the same episodes. The intervals are
    Wilson's (Clopper and Pearson's where all or no episodes are safe), and Newcombe's for
    differences.

    With --rare the probability of a violation is printed instead, with its interval and what plain
    Monte Carlo would need. For the columns see `docs/guides/evaluate.md`.
    """
    reads = text_options.inputs_of(env.system, policy, filters or (), learned or (), filter_spec)
    text_options.require_outputs(json, plot, episodes_out=episodes_out, latex=latex, inputs=reads)
    size = evaluation_options.size_of(size, plot)
    common: dict[str, Any] = {
        "filters": list(dict.fromkeys(filters)) if filters else None,
        "trust": trust,
        "options": env.arguments,
        "seed": seed,
        "knowledge": knowledge,
        "objective": objective,
        "confidence": confidence,
        "learned": learned or (),
        "monitoring": monitoring,
        "engine": engine,
    }
    if rare:
        refused = {
            "--filter-spec": filter_spec,
            "--refine": refine,
            "--plot": plot,
            "--latex": latex,
            "--no-bounds": not bounds,
            "--best": best,
            "--estimator": estimator,
            "--closed-loop": closed_loop,
            "--policy best": policy == "best",
            "--episodes-out": episodes_out,
            "--repeats": repeats != 1,
            "--jobs": jobs is not None,
            "--episodes": episodes is not None,
            "--num-envs": num_envs is not None,
        }
        sizes = {"particles": particles, "repetitions": repetitions}
        _evaluate_rare((json, timing), refused, env.full_id, policy, common | _given(sizes))
        return
    if particles is not None or repetitions is not None:
        raise ConfigurationError(
            "--particles and --repetitions are of --rare: give that too, or --episodes in their"
            " place"
        )
    third_party = filter_spec and env.env_id and not env.system
    common |= {"filter_spec": filter_spec, "repeats": repeats, "jobs": jobs, "best": best}
    common |= {"closed_loop": closed_loop, "estimator": estimator, "belief": belief}
    common |= {"observe": observe, "bounds": bounds}
    common |= {"record": plot is not None, **_given({"episodes": episodes, "num_envs": num_envs})}
    common |= {"episodes_out": episodes_out, "keep_episodes": False}
    problem = env.env_id if third_party else env.full_id
    found = _evaluate(problem, policy, refine, (json, timing), common)
    write_text_result(latex, found.to_latex)
    if plot is not None:
        from safe_envs.scripts.figures.evaluation import plot_evaluation

        plot_evaluation(found, plot, size=size)


def _evaluate(
    problem: Any,
    policy: str,
    refine: bool,
    outputs: tuple[Path | None, bool],
    arguments: dict[str, Any],
) -> Evaluation:
    """Evaluate, print and write, and return what was found with the control period as given."""
    from safe_envs.agents.evaluation import evaluate
    from safe_envs.scripts.reports.evaluation import print_evaluation, print_refinement

    json, timing = outputs
    found: Any
    with progress_bar("Evaluating") as progress:
        run: Any = evaluate.refine if refine else evaluate.evaluate
        found = run(problem, policy, progress=progress, **arguments)
    first = found.given if refine else found
    print_evaluation(stdout(), first, timing)
    if refine:
        print_refinement(stdout(), found)
    write_result(json, found.document)
    return first


def _evaluate_rare(
    outputs: tuple[Path | None, bool],
    refused: Mapping[str, Any],
    problem: Any,
    policy: str,
    arguments: dict[str, Any],
) -> None:
    """Estimate, print and write."""
    from safe_envs.agents.rare_events.estimate import estimate_rare
    from safe_envs.scripts.reports.evaluation import print_rare

    given = [name for name, value in refused.items() if value]
    if given:
        raise ConfigurationError(
            f"--rare does not go with {', '.join(given)}; leave one of them out"
        )
    with progress_bar("Splitting") as progress:
        found = estimate_rare(problem, policy, progress=progress, **arguments)
    json, timing = outputs
    print_rare(stdout(), found, timing)
    write_result(json, found.document)


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


if __name__ == "__main__":
    run_alone("evaluate", evaluate)
