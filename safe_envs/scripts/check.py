"""`safe-envs check`: whether the file of a barrier certificate is a proof."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import ConfigurationError
from safe_envs.scripts.options import early_checks, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, require_result, stdout, write_result


def check(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            callback=early_checks.file_that_is_there("`safe-envs certify --out FILE` writes one"),
            help="Of a certificate.",
            show_default=False,
        ),
    ],
    state: Annotated[
        list[str] | None,
        typer.Option(metavar="A,B,..", help="A start to print the bound of. Repeatable."),
    ] = None,
    seconds: Annotated[float, typer.Option(help="Limit of time.")] = 120.0,
    json: Json = None,
) -> None:
    """Check the certificate in a file: what it states, and whether that is so.

    All statements are checked by interval branch and bound that shares no code with the search for
    certificates. Where the file names an env, its system has to be exactly that of the env.

    The exit status is 0 where everything is checked, 1 where something is refuted or undecided, and
    2 where the file cannot be read. No code in the file is run.
    """
    from safe_envs.filters.certificates.checker import check as check_certificate
    from safe_envs.filters.certificates.files import load_certificate
    from safe_envs.filters.certificates.matching import env_difference
    from safe_envs.scripts.reports.certify import CheckAnswer, print_check
    from safe_envs.text import numbers

    if not 0 < seconds < float("inf"):
        raise ConfigurationError(f"seconds = {seconds}; give a number above 0")
    require_result(json)
    text_options.require_outputs(json, None, inputs=[("FILE", file)])
    certificate = load_certificate(file)
    starts = [numbers("--state", text) for text in state or []]
    n = len(certificate.plant.states)
    for start in starts:
        if len(start) != n:
            raise ConfigurationError(f"--state {start} has {len(start)} numbers; give {n}")
    found = check_certificate(certificate, seconds=seconds)
    answer = CheckAnswer(str(file), certificate, found, env_difference(certificate), starts)
    print_check(stdout(), answer)
    write_result(json, answer.document)
    if answer.word != "checked":
        sys.stdout.flush()
        raise SystemExit(1)


if __name__ == "__main__":
    run_alone("check", check)
