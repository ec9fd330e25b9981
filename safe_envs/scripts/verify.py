"""`safe-envs verify`: where a filter's conditions can be met, what they promise, and whether that
is true."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import require_whole
from safe_envs.scripts.options import completion, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import progress_bar, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env


@with_env
def verify(
    env: EnvOptions,
    filter_name: Annotated[
        str | None,
        typer.Option(
            "--filter",
            metavar="NAME",
            autocompletion=completion.filters,
            help="As for evaluate: scbf, hocbf:p=2,8, ... By default the env's own.",
        ),
    ] = None,
    knowledge: text_options.Knowledge = "model",
    policy: Annotated[
        str,
        typer.Option(
            metavar="NAME|FOLDER|FILE",
            autocompletion=completion.policies,
            help="Who acts in the simulation, as for evaluate.",
        ),
    ] = "nominal",
    trust: text_options.Trust = False,
    episodes: Annotated[
        int, typer.Option(help="Episodes of the simulation, from each start.")
    ] = 500,
    seed: text_options.Seed = 0,
    simulate: Annotated[
        bool,
        typer.Option(
            "--simulate/--no-simulate", help="Measure the safety, and hold it against the bounds."
        ),
    ] = True,
    json: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write all that was found; - for stdout, and nothing else there."
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help=(
                "Draw where the conditions cannot be met, h and the boundaries:"
                f" {text_options.FORMATS}"
            ),
        ),
    ] = None,
) -> None:
    """Print where the filter's conditions cannot be met, what bounds on its safety are estimated
    at, and what a simulation says to that.

    The safe set C is sampled, and searched for the worst: where the input has no say, where no
    action in the box meets the conditions, and the suprema on which the bounds rest. Nothing of
    this depends on the policy; the simulation does, and a bound that it contradicts is withheld.
    """
    from safe_envs.agents.evaluation.bound_check import judged, measure, starts_of
    from safe_envs.agents.policies.registry import make_policy
    from safe_envs.registry import make_problem, title_of
    from safe_envs.scripts.reports.verify_report import document, print_report
    from safe_envs.wrappers import parse_conditions
    from safe_envs.wrappers.verification.feasibility import verify as find

    require_whole("episodes", episodes, 1)
    text_options.require_outputs(
        json, plot, inputs=text_options.inputs_of(env.system, policy, [filter_name or ""])
    )
    known, arguments = env.full_id, env.arguments
    title = title_of(known, arguments)
    problem = make_problem(known, **arguments)
    actor = make_policy(
        policy, problem, trust
    )  # An unknown one is to show before the search, and without a simulation too.
    found = find(
        problem, parse_conditions(filter_name or problem.filter, problem), knowledge, seed=seed
    )
    starts = starts_of(problem, seed)
    bounds = found.guarantee.applicable_bounds(starts, problem.duration)
    measurements = []
    if simulate:
        with progress_bar("Simulating") as tell:
            measurements = measure(found, actor, episodes=episodes, seed=seed, progress=tell)
        bounds, measurements = judged(bounds, measurements, found)
    print_report(stdout(), title, found, starts, bounds, policy, measurements)
    config = {"env_id": known, "options": arguments, "policy": policy, "seed": seed}
    write_result(json, lambda: document(config, found, bounds, measurements))
    if plot is not None:
        from safe_envs.scripts.figures.verify_figure import draw

        draw(title, found, starts, plot)


if __name__ == "__main__":
    run_alone("verify", verify)
