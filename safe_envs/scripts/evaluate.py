"""`safe-envs evaluate`: how safe a policy is, bare and under filters."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from safe_envs.errors import ConfigurationError
from safe_envs.scripts.options import completion, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import progress_bar, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env

LEARNED_PARAMETERS = (
    "learned-hocbf:p=..:level=.95:eps=.. (quantile of the held-out errors that is the margin, or"
    " the margin itself), ddscbf:margin=0, bayesian-scbf:confidence=P or"
    " bayesian-scbf:simultaneous=P (robust at each state by itself, or at all at once), and with"
    " each file=FILE, as by --learned, and sampling_margin=M"
)


@with_env
def evaluate(
    env: EnvOptions,
    filter_spec: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.py:NAME",
            help=(
                "For an ENV_ID of somebody else, like Pendulum-v1: a FilterSpec that says how"
                " filters see it. Runs the file."
            ),
        ),
    ] = None,
    filters: Annotated[
        list[str] | None,
        typer.Option(
            "--filter",
            metavar="NAME",
            autocompletion=completion.filters,
            help=(
                "none, cbf, ecbf, hocbf, rcbf, srcbf, szcbf, scbf, and learned ones: learned-hocbf,"
                " ddscbf, bayesian-scbf; with "
                "parameters: hocbf:p=2,8; one for each barrier: hocbf:p=2,8+cbf:alpha=1."
                " Repeatable. By default none and the env's own. "
                f"Parameters of learned ones: {LEARNED_PARAMETERS}."
            ),
        ),
    ] = None,
    policy: Annotated[
        str,
        typer.Option(
            metavar="NAME|FOLDER|FILE",
            autocompletion=completion.policies,
            help=(
                "nominal, clf, zero, random, a folder of `safe-envs train`, or with --trust a .zip"
                " of Stable-Baselines3."
            ),
        ),
    ] = "nominal",
    trust: text_options.Trust = False,
    episodes: Annotated[int | None, typer.Option(help="Episodes for each filter. [1000]")] = None,
    seed: text_options.Seed = 0,
    knowledge: text_options.Knowledge = "model",
    objective: Annotated[
        str,
        typer.Option(
            metavar="nearest|clf",
            help=(
                "Of the filters: the action nearest to the policy's, or the joint program with the"
                " goal."
            ),
        ),
    ] = "nearest",
    learned: Annotated[
        list[Path] | None,
        typer.Option(
            "--learned",
            metavar="FILE",
            help="What `safe-envs identify` wrote, for the learned filters. Repeatable.",
        ),
    ] = None,
    repeats: Annotated[
        int,
        typer.Option(
            help="How often to learn, with new seeds: intervals are over identifications too."
        ),
    ] = 1,
    confidence: Annotated[
        float, typer.Option(metavar="C", help="Of all intervals, above 0 and below 1.")
    ] = 0.95,
    refine: Annotated[
        bool,
        typer.Option(
            "--refine",
            help="Repeat with dt/2 and dt/4, and say whether the safety rate has converged.",
        ),
    ] = False,
    monitoring: Annotated[
        str,
        typer.Option(
            metavar="discrete|continuous",
            help="Look at h at control instants only, or by Brownian bridges between them too.",
        ),
    ] = "discrete",
    rare: Annotated[
        bool,
        typer.Option(
            "--rare",
            help=(
                "Estimate P(violation) where it is too small for plain episodes, by splitting on h."
            ),
        ),
    ] = False,
    particles: Annotated[
        int | None,
        typer.Option(help="With --rare, in place of --episodes: episodes of a repetition. [250]"),
    ] = None,
    repetitions: Annotated[
        int | None,
        typer.Option(help="With --rare: independent ones, which give the interval. [20]"),
    ] = None,
    num_envs: Annotated[
        int | None,
        typer.Option(help="Episodes side by side; it changes the speed, not the answer. [1024]"),
    ] = None,
    jobs: Annotated[
        int, typer.Option(help="Processes; they change the speed, not the answer.")
    ] = 1,
    json: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help=(
                "Write configuration, versions, rows, comparisons and timing; - for stdout, and"
                " nothing else there."
            ),
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help=f"Draw h and the safety rate over time, and trajectories: {text_options.FORMATS}",
        ),
    ] = None,
) -> None:
    """Print the safety rate of a policy under each filter with its interval, and compare the
    filters pair by pair.

    An episode is safe if every barrier is positive at every control instant, or with --monitoring
    continuous between them too. After an episode's first violation its interventions, infeasible
    steps and effort are no longer counted. All filters see the same episodes. The intervals are
    Wilson's (Clopper and Pearson's where all or no episodes are safe), and Newcombe's for
    differences.

    With --rare the probability of a violation is printed instead, with its interval and what plain
    Monte Carlo would need.
    """
    from safe_envs.agents.evaluation import evaluate, refinement
    from safe_envs.scripts.reports.evaluation_report import print_evaluation, print_refinement

    text_options.require_outputs(
        json,
        plot,
        inputs=text_options.inputs_of(
            env.system, policy, filters or (), learned or (), filter_spec
        ),
    )
    names = list(dict.fromkeys(filters)) if filters else None
    if rare:
        from safe_envs.scripts.reports.rare_report import run_rare

        refused = {
            "--filter-spec": filter_spec,
            "--refine": refine,
            "--plot": plot,
            "--repeats": repeats != 1,
            "--jobs": jobs != 1,
        }
        refused |= {"--episodes": episodes is not None, "--num-envs": num_envs is not None}
        run_rare(
            json,
            refused,
            env.full_id,
            policy,
            filters=names,
            trust=trust,
            options=env.arguments,
            particles=particles,
            repetitions=repetitions,
            seed=seed,
            knowledge=knowledge,
            objective=objective,
            confidence=confidence,
            learned=learned or (),
            monitoring=monitoring,
        )
        return
    if particles is not None or repetitions is not None:
        raise ConfigurationError(
            "--particles and --repetitions are of --rare: give that too, or --episodes in their"
            " place"
        )
    run_all: Callable[..., Any] = refinement.refine if refine else evaluate.evaluate
    with progress_bar("Evaluating") as tell:
        answer = run_all(
            env.env_id if filter_spec and env.env_id and not env.system else env.full_id,
            policy,
            filters=names,
            filter_spec=filter_spec,
            trust=trust,
            options=env.arguments,
            seed=seed,
            knowledge=knowledge,
            objective=objective,
            confidence=confidence,
            learned=learned or (),
            repeats=repeats,
            monitoring=monitoring,
            jobs=jobs,
            progress=tell,
            record=plot is not None,
            **{
                name: value
                for name, value in (("episodes", episodes), ("num_envs", num_envs))
                if value is not None
            },
        )
    given = answer.evaluations[0] if refine else answer
    print_evaluation(stdout(), given)
    if refine:
        print_refinement(stdout(), answer)
    write_result(json, lambda: answer.document())
    if plot is not None:
        from safe_envs.scripts.figures.evaluation_figure import draw

        draw(given, plot)


if __name__ == "__main__":
    run_alone("evaluate", evaluate)
