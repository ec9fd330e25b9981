"""`safe-envs export`: a safety filter as C for a control loop."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.scripts.options import completion, early_checks, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, progress_bar, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env_at_state

if TYPE_CHECKING:
    from safe_envs.export.c_files import Interface
    from safe_envs.export.comparison import CComparison
    from safe_envs.export.export import ExportOptions
    from safe_envs.export.promise_comparison import PromiseComparison
    from safe_envs.filters.safety_filter import SafetyFilter
    from safe_envs.problem.problem import SafetyProblem
    from safe_envs.values.promise_filter import PromiseSettings


@with_env_at_state
def export(
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Folder of the files; made if it does not exist."),
    ],
    env: EnvOptions,
    filter_name: Annotated[
        str | None,
        typer.Option(
            "--filter",
            metavar="NAME",
            callback=early_checks.known_filter,
            autocompletion=completion.filters,
            help="As for evaluate: hocbf:alpha=2,8, promise:p=0.99, ... By default the env's own.",
        ),
    ] = None,
    knowledge: text_options.Knowledge = "model",
    objective: Annotated[
        str,
        typer.Option(
            metavar="nearest|clf",
            callback=early_checks.one_of("objective", ("nearest", "clf")),
            help="To the proposed input, or the env's goal.",
        ),
    ] = "nearest",
    float32: Annotated[
        bool, typer.Option("--float32", help="Compute in single precision.")
    ] = False,
    name: Annotated[
        str, typer.Option(help="With which all public names of the C begin.")
    ] = "safety_filter",
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="Build the C with the compiler at hand, or $CC, and hold it against Python.",
        ),
    ] = False,
    states: Annotated[int, typer.Option(help="States of the comparison.")] = 1_000_000,
    seed: text_options.Seed = 0,
    json: Json = None,
) -> None:
    """Write a filter as C99: filter.h, filter.c, a self-test, CMakeLists.txt and README.md.

    The C needs <math.h> alone and allocates nothing. It has the operations of the filter in the
    same order, so that flags are equal and actions differ by rounding. The README has the names,
    units and order of what goes in and comes out. Files of the same names that no export has
    written are not overwritten.
    """
    from safe_envs.export.export import ExportOptions
    from safe_envs.filters.conditions.syntax import names_backup, names_promise
    from safe_envs.registry import make_problem, title_of
    from safe_envs.scripts.reports.export import ExportAnswer, print_export
    from safe_envs.values.promise_filter import PromiseSettings

    require_whole("states", states, 1)
    require_whole("seed", seed, 0)
    text = filter_name or ""
    text_options.require_outputs(json, None, inputs=text_options.inputs_of(env.system, "", [text]))
    known, arguments = env.full_id, env.arguments
    problem = make_problem(known, **arguments)
    units = {v.symbol.name: v.unit for v in (*problem.states, *problem.inputs)}
    options = ExportOptions(name, units, problem.sampling_domain.region)
    tried = (states, seed) if compare else None
    if names_backup(text):
        raise ConfigurationError(
            f"the filter {text} has no form in C: it simulates plans. Export a condition, such as"
            f" {problem.filter}, or the promise filter"
        )
    if names_promise(text):
        settings = PromiseSettings.of_text(text)
        settings.require_fit(problem, objective)
        interface, found = _promise(problem, settings, knowledge, out, float32, options, tried)
    else:
        safety_filter = _conditions(problem, text or problem.filter, knowledge, objective)
        interface, found = _closed_form(safety_filter, out, float32, options, tried)
    config = {"env_id": known, "options": arguments, "filter": text or problem.filter, "seed": seed}
    answer = ExportAnswer(title_of(known, arguments), config, str(out), interface, found)
    print_export(stdout(), answer)
    write_result(json, answer.document)


def _conditions(problem: SafetyProblem, text: str, knowledge: str, objective: str) -> SafetyFilter:
    from safe_envs.filters.conditions.text import parse_conditions
    from safe_envs.filters.safety_filter import SafetyFilter

    conditions = parse_conditions(text, problem)
    return SafetyFilter.for_problem(problem, conditions, knowledge, objective)


def _closed_form(
    safety_filter: SafetyFilter,
    out: Path,
    float32: bool,
    options: ExportOptions,
    tried: tuple[int, int] | None,
) -> tuple[Interface, CComparison | None]:
    """Export conditions in closed form, and compare at a number of states with a seed."""
    from safe_envs.export.comparison import compare
    from safe_envs.export.export import export_filter

    interface = export_filter(safety_filter, out, float32, options)
    if tried is None:
        return interface, None
    return interface, compare(out, safety_filter, options, states=tried[0], seed=tried[1])


def _promise(
    problem: SafetyProblem,
    settings: PromiseSettings,
    knowledge: str,
    out: Path,
    float32: bool,
    options: ExportOptions,
    tried: tuple[int, int] | None,
) -> tuple[Interface, PromiseComparison | None]:
    """Export a promise filter, and compare at a number of states with a seed."""
    from safe_envs.export.promise_comparison import compare_promise
    from safe_envs.export.promise_export import export_promise
    from safe_envs.values.promise_filter import promise_filter_for

    with progress_bar("Computing the table") as tell:
        promise_filter = promise_filter_for(problem, settings, knowledge, tell)
    interface = export_promise(promise_filter, out, float32, options)
    if tried is None:
        return interface, None
    found = compare_promise(out, promise_filter, options, states=tried[0], seed=tried[1])
    return interface, found


if __name__ == "__main__":
    run_alone("export", export)
