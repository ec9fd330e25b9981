"""`safe-envs export`: a safety filter as C for a control loop."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.scripts.options import completion, early_checks, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env_at_state


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
            help="As for evaluate: hocbf:alpha=2,8, scbf, ... By default the env's own.",
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
    """Write a filter as C99: header, source, core, self-test, CMakeLists.txt and README.md.

    The C needs <math.h> alone and allocates nothing. It solves the same quadratic program as the
    filter in Python: flags are equal where they do not hang on rounding, and actions differ by
    rounding. The README has the names, units and order of what goes in and comes out. Files of the
    same names that no export has written are not overwritten.
    """
    from safe_envs.export.comparison import compare as compare_filter
    from safe_envs.export.export import ExportOptions, export_filter
    from safe_envs.filters.conditions.syntax import names_backup, names_promise
    from safe_envs.filters.conditions.text import parse_conditions
    from safe_envs.filters.safety_filter import SafetyFilter
    from safe_envs.registry import make_problem, title_of
    from safe_envs.scripts.reports.export import ExportAnswer, print_export

    require_whole("states", states, 1)
    require_whole("seed", seed, 0)
    text = filter_name or ""
    text_options.require_outputs(json, None, inputs=text_options.inputs_of(env.system, "", [text]))
    known, arguments = env.full_id, env.arguments
    problem = make_problem(known, **arguments)
    units = {v.symbol.name: v.unit for v in (*problem.states, *problem.inputs)}
    options = ExportOptions(name, units, problem.sampling_domain.region)
    if names_backup(text) or names_promise(text):
        why = "it simulates plans" if names_backup(text) else "its tables are not exported for now"
        raise ConfigurationError(
            f"the filter {text} has no form in C: {why}. Export a condition, such as"
            f" {problem.filter}"
        )
    conditions = parse_conditions(text or problem.filter, problem)
    safety_filter = SafetyFilter.for_problem(problem, conditions, knowledge, objective)
    interface = export_filter(safety_filter, out, float32, options)
    found = None
    if compare:
        found = compare_filter(out, safety_filter, options, states=states, seed=seed)
    config = {"env_id": known, "options": arguments, "filter": text or problem.filter, "seed": seed}
    answer = ExportAnswer(title_of(known, arguments), config, str(out), interface, found)
    print_export(stdout(), answer)
    write_result(json, answer.document)


if __name__ == "__main__":
    run_alone("export", export)
