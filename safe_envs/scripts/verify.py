"""`safe-envs verify`: where a filter's conditions can be met, and what bounds its safety has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import require_whole
from safe_envs.scripts.options import completion, early_checks, evaluation_options, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, progress_bar, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env_at_state


@with_env_at_state
def verify(
    env: EnvOptions,
    filter_name: Annotated[
        str | None,
        typer.Option(
            "--filter",
            metavar="NAME",
            callback=early_checks.known_filter,
            autocompletion=completion.filters,
            help="As for evaluate: scbf, hocbf:alpha=2,8, ... By default the env's own.",
        ),
    ] = None,
    knowledge: text_options.Knowledge = "model",
    policy: Annotated[
        str,
        typer.Option(
            metavar="NAME|FOLDER|FILE",
            callback=early_checks.known_policy,
            autocompletion=completion.policies,
            help="Who acts in the simulation, as for evaluate.",
        ),
    ] = "nominal",
    trust: text_options.Trust = False,
    episodes: Annotated[int, typer.Option(help="Episodes of the simulation.")] = 500,
    seed: text_options.Seed = 0,
    simulate: Annotated[
        bool,
        typer.Option(
            "--simulate/--no-simulate", help="Measure the safety, and hold it against the bounds."
        ),
    ] = True,
    best: evaluation_options.Best = False,
    closed_loop: evaluation_options.ClosedLoop = False,
    engine: text_options.Engine = "auto",
    json: Json = None,
    plot: Annotated[
        Path | None,
        text_options.plot_option("Draw where no action meets the conditions, and h"),
    ] = None,
    size: evaluation_options.Size = None,
) -> None:
    """Print where a filter's conditions cannot be met, and its bounds next to a simulation.

    The safe set C is sampled, and searched for the worst states: where the input has no effect,
    where no action within the input bounds meets the conditions, and the suprema that the bounds
    need. A judge then proves the hypotheses and numbers of the bounds, refutes them, or leaves
    them undecided. None of this depends on the policy; the simulation does, and a bound that it
    contradicts is withheld. At the end the rate stands between a bound for the env's own steps and
    what any policy can attain, with --closed-loop and --best.
    """
    from safe_envs.agents.evaluation.attainable import best_for
    from safe_envs.agents.evaluation.bounds import FilteredPolicy
    from safe_envs.agents.evaluation.safety_chain import (
        measure,
        safety_chain,
        starts_of,
        withhold_contradicted,
    )
    from safe_envs.agents.policies.registry import make_policy
    from safe_envs.engine.choice import require_engine
    from safe_envs.filters.conditions.text import parse_conditions
    from safe_envs.proofs import feasibility
    from safe_envs.registry import make_problem, title_of
    from safe_envs.scripts.reports.verify import VerifyAnswer, print_report

    require_whole("episodes", episodes, 1)
    require_engine(engine)
    inputs = text_options.inputs_of(env.system, policy, [filter_name or ""])
    text_options.require_outputs(json, plot, inputs=inputs)
    size = evaluation_options.size_of(size, plot)
    known, arguments = env.full_id, env.arguments
    problem = make_problem(known, **arguments)
    # An unknown policy is an error before the search, and without a simulation too.
    actor = make_policy(policy, problem, trust)
    conditions = parse_conditions(filter_name or problem.filter, problem)
    found = feasibility.verify(problem, conditions, knowledge, seed=seed)
    starts = starts_of(problem, seed)
    bounds, measurements = found.guarantee.applicable_bounds(starts, problem.duration), []
    if simulate:
        with progress_bar("Simulating") as tell:
            measurements = measure(
                found, actor, episodes=episodes, seed=seed, engine=engine, progress=tell
            )
        bounds, measurements = withhold_contradicted(bounds, measurements, found)
    attainable = None
    if best:
        with progress_bar("Best attainable safety") as tell:
            attainable = best_for(problem, tell)
    filtered = FilteredPolicy(
        problem, tuple(conditions), knowledge, policy, closed_loop=closed_loop
    )
    chain = safety_chain(filtered, starts, bounds, measurements, attainable)
    config = {"env_id": known, "options": arguments, "policy": policy, "seed": seed}
    title = title_of(known, arguments)
    answer = VerifyAnswer(title, config, policy, found, starts, bounds, measurements, chain)
    print_report(stdout(), answer)
    write_result(json, answer.document)
    if plot is not None:
        from safe_envs.scripts.figures.verify import plot_verification

        plot_verification(found, plot, starts=starts, title=title, size=size)


if __name__ == "__main__":
    run_alone("verify", verify)
