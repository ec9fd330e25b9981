"""`safe-envs identify`: learn what a model lacks, keep it in a file, and hold it against the truth."""

from __future__ import annotations

import functools
import inspect
import typing
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from safe_envs.errors import ConfigurationError, nearest, require_whole, shortened, shown
from safe_envs.number_text import named_values, real
from safe_envs.scripts.options import completion, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import progress_bar, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env

_NOT_SETTINGS = ("problem", "data", "seed", "step", "progress")
_OF_COLLECTING = ("starts", "steps", "points", "repetitions")
"""Settings that say which data are collected."""

SETTINGS = {
    "learned-hocbf": "states=3000, label_dt=0.001, hidden=100,30, epochs=500",
    "ddscbf": (
        "points=200, repetitions=50000, estimator=martingale (or centred, printed), way=network or"
        " direct (by default what suits)"
    ),
    "bayesian": (
        "starts=1000, steps=1, repetitions=100, degree=1 to 3 or more (by default by the number of"
        " rows), prior=10.0, diffusion_degree=0, alpha=1.0, beta=1.0"
    ),
}
"""What `--set` takes for each method, for the help: the functions themselves are too heavy to
import for it."""

_SETTINGS_HELP = "\n\n".join(
    (
        "Setting of the method, repeatable; with the defaults:",
        *(f"{m}: {text}." for m, text in SETTINGS.items()),
    )
)


@functools.partial(with_env, without=("horizon", "start"))
def identify(
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            autocompletion=completion.words(tuple(SETTINGS)),
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
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help=_SETTINGS_HELP),
    ] = None,
    seed: text_options.Seed = 0,
    json: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help=(
                "Write configuration, versions, record and errors; - for stdout, and nothing else"
                " there."
            ),
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help=f"Draw the truth against the estimate: {text_options.FORMATS}"
        ),
    ] = None,
) -> None:
    """Learn of a system by a method, and print how far what was learned is from the truth.

    The plant is only stepped, or not at all with --data: then --dt, --substeps, --box and settings
    of what is collected are refused. The truth, with which the estimates are compared at states
    drawn anew from where the problem is explored, is that of the plant, with its --noise.
    """
    from safe_envs.registry import make_problem, title_of
    from safe_envs.scripts.reports.identify_report import (
        Identification,
        Source,
        compare,
        document,
        print_report,
    )
    from safe_envs.wrappers.learning import learner_of
    from safe_envs.wrappers.learning.identifiability import IdentifiabilityWarning

    require_whole("seed", seed, 0)
    inputs = [*text_options.inputs_of(env.system), *([] if data is None else [("--data", data)])]
    text_options.require_outputs(json, plot, out=out, inputs=inputs)
    arguments = env.arguments
    learner = learner_of(method)
    chosen = read_settings(method, learner, settings or ())
    source: dict[str, Any] = {}
    if data is not None:
        _refuse_collecting(chosen, env)
        source = {"data": _load_data(method, learner, data)}
    problem = make_problem(env.full_id, **arguments)
    with progress_bar("Learning") as tell, warnings.catch_warnings():
        # They are in the record, and printed with the results.
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        learned = learner(problem, seed=seed, progress=tell, **source, **chosen)
    learned.save(out)
    found = Identification(
        env_id=env.full_id,
        title=title_of(env.full_id, arguments),
        problem=problem,
        learned=learned,
        functions=compare(learned, problem, seed),
        options=arguments,
        seed=seed,
        source=None if data is None else Source.of(data, source["data"]),
        out=out,
        use=env.evaluate_command("--filter", _filter_of(method), "--learned", str(out)),
    )
    print_report(stdout(), found)
    write_result(json, lambda: document(found))
    if plot is not None:
        from safe_envs.scripts.figures.identify_figure import draw

        draw(found, plot)


def read_settings(method: str, learner: Callable[..., Any], texts: Sequence[str]) -> dict[str, Any]:
    """Read NAME=VALUE entries as keyword arguments of the function that learns by a method.

    Raises:
        ConfigurationError: the function has no such argument, or the value is not of its kind.
    """
    allowed = settings_of(learner)
    hints = typing.get_type_hints(learner)
    found = named_values("--set", texts, words=True)
    for name, value in found.items():
        if name not in allowed:
            given = shortened(f"{name}={value}")
            raise ConfigurationError(
                f"--set {given}: {method} has no setting {shown(name)}; {nearest(name, allowed)}"
            )
        found[name] = _of_kind(name, value, hints[name])
    return found


def settings_of(learner: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """The settings of the function that learns by a method, by name."""
    return {
        name: found
        for name, found in inspect.signature(learner).parameters.items()
        if name not in _NOT_SETTINGS
    }


def _refuse_collecting(settings: Mapping[str, Any], env: EnvOptions) -> None:
    """Raise ConfigurationError if a setting or an option only says how data are collected."""
    idle = [f"--set {name}" for name in _OF_COLLECTING if name in settings]
    idle += [f"--{name}" for name in ("dt", "substeps", "box") if name in env.changes]
    if idle:
        raise ConfigurationError(
            f"{', '.join(idle)}: not allowed with --data, since nothing is collected then; leave"
            " it out"
        )


def _of_kind(name: str, value: float | str, hint: Any) -> Any:
    """A value as an argument with a type hint takes it: a word, a list of whole numbers, or a
    number."""
    parts = (hint, *typing.get_args(hint))
    origins = {typing.get_origin(part) for part in parts}
    if typing.Literal in origins:
        return str(value)
    if Sequence in origins:
        try:
            return [_whole(real(entry)) for entry in str(value).split(",")]
        except ValueError as error:
            given = shortened(f"{name}={value}")
            raise ConfigurationError(
                f"--set {given}: give whole numbers with commas between, such as {name}=100,30"
            ) from error
    if isinstance(value, str):
        raise ConfigurationError(
            f"--set {shortened(name)}={shortened(value)}: {shown(value)} is not a number"
        )
    # A whole number may be written as 1e3; what is not whole, the method refuses.
    return int(value) if int in parts and float(value).is_integer() else value


def _whole(value: float) -> int:
    if not value.is_integer():
        raise ValueError(f"{value} is not whole")
    return int(value)


def _load_data(method: str, learner: Callable[..., Any], path: Path) -> Any:
    """The data of a file, for a method that can learn from any.

    Raises:
        ConfigurationError: the method cannot, or the file holds none.
    """
    from safe_envs.wrappers.learning.data.transitions import Transitions

    if "data" not in inspect.signature(learner).parameters:
        raise ConfigurationError(
            f"--data {path}: {method} needs paths of several steps under a held input, which single"
            " steps are not; leave --data out, and they are collected from the plant"
        )
    return Transitions.load(path)


def _filter_of(method: str) -> str:
    """The name of the filter that uses what a method learns."""
    from safe_envs.wrappers.conditions import LEARNED

    (name,) = [condition.name for condition in LEARNED.values() if condition.method == method]
    return name


if __name__ == "__main__":
    run_alone("identify", identify)
