"""`safe-envs train`: an agent of Stable-Baselines3, with a filter in the loop or without one."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import ConfigurationError
from safe_envs.scripts.options import completion, early_checks, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, progress_bar, say, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env
from safe_envs.scripts.options.settings import read_hyperparameters
from safe_envs.text import visible


@with_env
def train(
    algo: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            autocompletion=completion.algorithms,
            callback=early_checks.known_algorithm,
            help="ppo, a2c, sac or td3; with a limit on violations ppo-lag or sac-lag.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            callback=early_checks.folder_to_write,
            help="New folder for the policy, its evaluations and the checkpoint.",
        ),
    ],
    env: EnvOptions,
    filters: Annotated[
        list[str] | None,
        typer.Option(
            "--filter",
            metavar="NAME",
            callback=early_checks.known_filters,
            autocompletion=completion.filters,
            help=(
                "Filter in the loop; none by default. A learned one with its file:"
                " ddscbf:file=FILE."
            ),
        ),
    ] = None,
    n_timesteps: Annotated[
        int | None,
        typer.Option(
            help=(
                "Control periods over all copies, rounded up to whole rollouts; by default that of"
                " the hyperparameters."
            )
        ),
    ] = None,
    num_envs: Annotated[
        int | None, typer.Option(help="Copies of the env; by default that of the hyperparameters.")
    ] = None,
    seed: text_options.Seed = 0,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Hyperparameter in place of the file's, such as learning_rate=3e-4. Repeatable.",
        ),
    ] = None,
    action: Annotated[
        str,
        typer.Option(
            metavar="executed|proposed|both",
            help=(
                "Action that sac, td3 and sac-lag learn on behind a filter. Stable-Baselines3"
                " itself takes the proposed one."
            ),
        ),
    ] = "executed",
    intervention_penalty: Annotated[
        float,
        typer.Option(
            metavar="X",
            help="Subtract X from the reward for each unit by which the filter changes the action.",
        ),
    ] = 0.0,
    promise_curriculum: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help="Begin with the probability P for the promise filter, and raise it to its p.",
        ),
    ] = None,
    curriculum_part: Annotated[
        float,
        typer.Option(metavar="X", help="Share of the training over which p rises."),
    ] = 0.5,
    cost_limit: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            help="For ppo-lag and sac-lag: limit the mean number of unsafe steps in an episode.",
        ),
    ] = None,
    violation_limit: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help=(
                "In place of --cost-limit: limit the probability that an episode has any unsafe"
                " step, 0.01 by default. Training episodes end at their first one."
            ),
        ),
    ] = None,
    knowledge: text_options.Knowledge = "model",
    estimator: Annotated[
        str | None,
        typer.Option(
            metavar="kf|ekf|ukf",
            callback=early_checks.known_estimator,
            help="With --measurement: the agent and the filter act at an estimate of the state.",
        ),
    ] = None,
    eval_freq: Annotated[
        int | None,
        typer.Option(
            help="Steps between evaluations and checkpoints; by default a tenth of the training."
        ),
    ] = None,
    eval_episodes: Annotated[int, typer.Option(help="Episodes of each evaluation.")] = 200,
    threads: Annotated[int, typer.Option(help="Threads of torch and BLAS.")] = 1,
    engine: text_options.Engine = "auto",
    tensorboard: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write logs for tensorboard.")
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue the unfinished training in --out from its last checkpoint.",
        ),
    ] = False,
    json_file: Json = None,
) -> None:
    """Train an agent, evaluate it on the way, and keep the last and the best policy.

    The default hyperparameters are in safe_envs/agents/training/hyperparams, in the format of the
    RL Zoo. progress.jsonl, and tensorboard if asked for, log the safety rate, the cost and the
    minimum h of the last episodes, and the violations, interventions and infeasible steps of the
    training so far. `safe-envs evaluate --policy DIR` reads the folder.
    """
    from safe_envs.agents.training.config import Training
    from safe_envs.scripts.reports.sweep import print_evaluations

    text_options.require_outputs(
        json_file, None, inputs=text_options.inputs_of(env.system, filters=filters or ())
    )
    if filters and len(filters) > 1:
        raise ConfigurationError(
            f"--filter was given {len(filters)} times; a training has one filter in the loop"
        )
    training = Training.of(
        env.full_id,
        algo,
        filter=filters[0] if filters else None,
        options=env.arguments,
        knowledge=knowledge,
        estimator=estimator,
        n_timesteps=n_timesteps,
        num_envs=num_envs,
        settings=read_hyperparameters(settings or []),
        seed=seed,
        action=action,
        intervention_penalty=intervention_penalty,
        promise_curriculum=promise_curriculum,
        curriculum_part=curriculum_part,
        cost_limit=cost_limit,
        violation_limit=violation_limit,
        eval_freq=eval_freq,
        eval_episodes=eval_episodes,
        threads=threads,
        engine=engine,
    )
    from safe_envs.agents.policies.names import POLICY_FILE
    from safe_envs.agents.training.trainer import train as train_agent

    # The policy itself is written at the very end.
    finished = resume and os.path.exists(out / POLICY_FILE)
    with progress_bar("Training") as tell:
        try:
            train_agent(training, out, resume=resume, tensorboard=tensorboard, progress=tell)
        except KeyboardInterrupt:
            advice = "The same command with --resume goes on after the last checkpoint in"
            print(f"Stopped. {advice} {visible(str(out))}.", file=sys.stderr)
            raise
    if finished:
        say(stdout(), f"The training in {out} was finished already: nothing was left to do.")
    rows = json.loads((out / "evaluations.json").read_text())
    filter_name = training.filter or "none"
    print_evaluations(stdout(), filter_name, rows)
    known = [f"--knowledge={knowledge}"] if knowledge != "model" else []
    known += [] if estimator is None else [f"--estimator={estimator}"]
    command = env.evaluate_command("--policy", str(out), "--filter", filter_name, *known)
    say(stdout(), f"\nTo evaluate the policy: {command}")
    config = json.loads((out / "config.json").read_text())
    write_result(json_file, lambda: {"folder": str(out), "config": config, "evaluations": rows})


if __name__ == "__main__":
    run_alone("train", train)
