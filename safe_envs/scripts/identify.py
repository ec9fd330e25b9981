"""`safe-envs identify`: learn what a model lacks, save it, and compare it with the truth."""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.scripts.options import completion, early_checks, evaluation_options, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, progress_bar, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env
from safe_envs.scripts.options.settings import (
    SETTINGS,
    SETTINGS_HELP,
    read_settings,
    refuse_collecting,
)

if TYPE_CHECKING:
    from safe_envs.filters.learning.data import Transitions


@functools.partial(with_env, without=("horizon", "start"))
def identify(
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            autocompletion=completion.words(tuple(SETTINGS)),
            callback=early_checks.known_method,
            help=(
                "learned-hocbf: residuals of derivatives of the barriers; ddscbf: unknown noise;"
                " bayesian: the whole system."
            ),
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(metavar="FILE", help="Where what was learned goes: an npz, without pickle."),
    ],
    env: EnvOptions,
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Learn from these, an npz of Transitions.save, instead of collecting data.",
        ),
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help=SETTINGS_HELP)
    ] = None,
    seed: text_options.Seed = 0,
    json: Json = None,
    plot: Annotated[
        Path | None, text_options.plot_option("Draw the truth against the estimate")
    ] = None,
    size: evaluation_options.Size = None,
) -> None:
    """Learn of a system by a method, and print how far what was learned is from the truth.

    The plant is only stepped, or not at all with --data: then --dt, --substeps, --input-bounds and
    settings of what is collected are refused. The truth, with which the estimates are compared at
    fresh states of the sampling domain, is that of the plant, with its --noise.
    """
    from safe_envs.filters.learning import learner_of
    from safe_envs.filters.learning.bayesian import IdentifiabilityWarning
    from safe_envs.registry import make_problem, title_of
    from safe_envs.scripts.reports.identify import DataFile, IdentifyAnswer, compare, print_report

    require_whole("seed", seed, 0)
    inputs = [*text_options.inputs_of(env.system), *([] if data is None else [("--data", data)])]
    text_options.require_outputs(json, plot, out=out, inputs=inputs)
    size = evaluation_options.size_of(size, plot)
    arguments = env.arguments
    learner = learner_of(method)
    chosen = read_settings(method, learner, settings or ())
    transitions = None
    if data is not None:
        refuse_collecting(chosen, env)
        transitions = _load_data(method, learner, data)
        chosen["data"] = transitions
    problem = make_problem(env.full_id, **arguments)
    with progress_bar("Learning") as tell, warnings.catch_warnings():
        # They are in the record, and printed with the results.
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        learned = learner(problem, seed=seed, progress=tell, **chosen)
    learned.save(out)
    found = IdentifyAnswer(
        env_id=env.full_id,
        title=title_of(env.full_id, arguments),
        problem=problem,
        learned=learned,
        functions=compare(learned, problem, seed),
        options=arguments,
        seed=seed,
        source=None if data is None or transitions is None else DataFile(data, transitions),
        out=out,
        use=env.evaluate_command(
            *("--filter", _filter_of(method), "--learned", str(out)),
            *([] if problem.measurement is None else ["--estimator", "ekf"]),
        ),
    )
    print_report(stdout(), found)
    write_result(json, found.document)
    if plot is not None:
        from safe_envs.scripts.figures.identify import plot_identification

        plot_identification(found, plot, size=size)


def _load_data(method: str, learner: Callable[..., Any], path: Path) -> Transitions:
    """Load the data of a file, for a method that can learn from them."""
    from safe_envs.filters.learning.data import Transitions

    if "data" not in inspect.signature(learner).parameters:
        raise ConfigurationError(
            f"--data {path}: {method} needs paths of several steps under a held input, which single"
            " steps are not; leave --data out, and they are collected from the plant"
        )
    return Transitions.load(path)


def _filter_of(method: str) -> str:
    """Return the name of the filter that uses what a method learns."""
    from safe_envs.filters.conditions.registry import LEARNED

    (name,) = [condition.name for condition in LEARNED.values() if condition.method == method]
    return name


if __name__ == "__main__":
    run_alone("identify", identify)
