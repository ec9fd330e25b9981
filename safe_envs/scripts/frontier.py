"""`safe-envs frontier`: how much return safety costs, and what filters give up for theirs."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from safe_envs.errors import require_whole
from safe_envs.scripts.options import completion, early_checks, evaluation_options, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, progress_bar, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env_at_state

if TYPE_CHECKING:
    from safe_envs.problem.problem import SafetyProblem

PROMISES = ("promise:p=0.9", "promise:p=0.99", "promise:p=0.999")
"""Filters that are looked at without being named, where they suit."""

_BEST = "best"


@with_env_at_state
def frontier(
    env: EnvOptions,
    filters: Annotated[
        list[str] | None,
        typer.Option(
            "--filter",
            metavar="NAME",
            callback=early_checks.known_filters,
            autocompletion=completion.filters,
            help="Filter over the nominal controller, next to the env's own and "
            + ", ".join(PROMISES)
            + ". Repeatable.",
        ),
    ] = None,
    policies: Annotated[
        list[str] | None,
        typer.Option(
            "--policy",
            metavar="NAME|FOLDER|FILE",
            callback=early_checks.known_policies,
            autocompletion=completion.policies,
            help="Who acts without a filter, next to the nominal controller. Repeatable.",
        ),
    ] = None,
    steps: Annotated[
        int,
        typer.Option(
            "--train",
            metavar="STEPS",
            help="Train PPO without a filter for so many control periods; 0 trains none.",
        ),
    ] = 0,
    trust: text_options.Trust = False,
    knowledge: text_options.Knowledge = "model",
    leaving: evaluation_options.Leaving = "violation",
    prices: Annotated[
        int, typer.Option(help="Prices of a violation for which returns are computed.")
    ] = 12,
    cells: Annotated[
        str | None,
        typer.Option(
            metavar="N|NxM|NxMxL",
            help="Nodes along each coordinate of the safe set; by default as many as suit the env.",
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Episodes of each policy and filter.")] = 1000,
    attained: Annotated[
        int, typer.Option(help="Episodes of each of the policies that prices lead to.")
    ] = 500,
    seed: text_options.Seed = 0,
    json: Json = None,
    plot: Annotated[Path | None, text_options.plot_option("Draw the curve and the points")] = None,
    size: evaluation_options.Size = None,
) -> None:
    """Print the largest returns that can be had at each risk, next to those of filters.

    The curve is computed by dynamic programming with a price that is paid once for the first
    violation, on a grid, whose error is not bounded. Episodes of policies that the prices lead to,
    of the nominal controller, of filters over it and of the safest policy show what is attained.
    """
    from safe_envs.agents.evaluation.frontier import FrontierSpec
    from safe_envs.agents.evaluation.frontier import frontier as compute
    from safe_envs.registry import make_problem, title_of
    from safe_envs.scripts.reports.frontier import document, print_report
    from safe_envs.values.frontier import FrontierSettings, rewarded

    for name, value, least in (("episodes", episodes, 1), ("attained", attained, 0)):
        require_whole(name, value, least)
    require_whole("train", steps, 0)
    named, given = list(policies or ()), list(filters or ())
    files = [file for policy in named for file in text_options.inputs_of(None, policy)]
    files += text_options.inputs_of(env.system, filters=given)
    text_options.require_outputs(json, plot, inputs=files)
    size = evaluation_options.size_of(size, plot)
    known, arguments = env.full_id, env.arguments
    problem = make_problem(known, **arguments)
    settings = FrontierSettings(
        prices=prices,
        policies=6 if attained else 0,
        cells=evaluation_options.cells_of(cells, "120x80"),
        leaving=leaving,
    )
    rewarded(problem)  # Raises where there is no curve, before an agent is trained.
    own = [name for name in (problem.filter, *PROMISES) if name not in given]
    acting: dict[str, Any] = {"nominal": "nominal", **{name: name for name in named}}
    if steps:
        acting["ppo"] = _trained(env, problem, steps, seed)
    spec = FrontierSpec(
        policies=acting | {_BEST: _BEST},
        filters=[*own, *given],
        may_miss=[*(name for name in PROMISES if name not in given), *{_BEST} - {*named}],
        episodes=episodes,
        attained=attained,
        seed=seed,
        knowledge=knowledge,
        trust=trust,
    )
    with progress_bar("Computing") as tell:
        found = compute(problem, spec, settings, tell)
    title = title_of(known, arguments)
    print_report(stdout(), title, found)
    config = {"env_id": known, "options": arguments, "seed": seed, "knowledge": knowledge}
    write_result(json, lambda: document(found, config))
    if plot is not None:
        from safe_envs.scripts.figures.frontier import plot_frontier

        plot_frontier(found, plot, title=title, size=size)


def _trained(env: EnvOptions, problem: SafetyProblem, steps: int, seed: int) -> Any:
    """Train PPO, and return its policy."""
    from safe_envs.agents.policies.network import load_policy
    from safe_envs.agents.training.config import Training
    from safe_envs.agents.training.trainer import train

    training = Training.of(
        env.full_id,
        "ppo",
        options=env.arguments,
        n_timesteps=steps,
        seed=seed,
        eval_freq=steps,
        eval_episodes=1,
    )
    with tempfile.TemporaryDirectory() as folder, progress_bar("Training") as tell:
        train(training, Path(folder) / "ppo", progress=tell)
        return load_policy(str(Path(folder) / "ppo"), problem)


if __name__ == "__main__":
    run_alone("frontier", frontier)
