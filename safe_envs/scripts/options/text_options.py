"""Options of several commands, and from the text of options to arguments."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.files import require_writable
from safe_envs.scripts.options import early_checks
from safe_envs.scripts.options.console import STDOUT

KNOWLEDGE = early_checks.one_of("knowledge", ("model", "plant"))

Knowledge = Annotated[
    str,
    typer.Option(metavar="model|plant", callback=KNOWLEDGE, help="What the filters know."),
]
Trust = Annotated[
    bool,
    typer.Option(
        "--trust",
        help=(
            "Load a policy that is a .zip. That runs code in it: only for files whose source you"
            " trust."
        ),
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all randomness.")]
Engine = Annotated[
    str,
    typer.Option(
        metavar="auto|numpy|compiled",
        callback=early_checks.one_of("engine", ("auto", "numpy", "compiled")),
        help=(
            "What simulates: NumPy, or a program that Numba compiles once. auto takes that for long"
            " runs."
        ),
    ),
]
PLOT_FORMATS = ("png", "pdf", "svg", "eps", "jpg", "jpeg", "ps", "tif", "tiff", "webp")
"""Suffixes of pictures, all of which matplotlib writes: to ask it takes longer than all else. Not
among them are pgf, which needs a TeX installation, and svgz, which holds the time."""

FORMATS = ".png, .pdf, .svg, .eps, .jpg, .tif or .webp."


def plot_option(what: str) -> Any:
    """Return the option for the file of a picture; `what` says what is drawn."""
    return typer.Option(metavar="FILE", help=f"{what}: {FORMATS}")


def require_outputs(
    json: Path | None,
    plot: Path | None,
    *,
    out: Path | None = None,
    episodes_out: Path | None = None,
    latex: Path | None = None,
    inputs: Iterable[tuple[str, Path]] = (),
) -> None:
    """Check, before any work, that --out, --json and --plot can be written to different files.

    Args:
        json: of --json, if given.
        plot: of --plot, if given.
        out: of --out, where a command has it.
        episodes_out: of --episodes-out, where a command has it.
        latex: of --latex, where a command has it.
        inputs: options and the files that they read, which are not to be overwritten.

    Raises:
        ConfigurationError: one cannot.
    """
    if json == latex == STDOUT:
        raise ConfigurationError(
            "--json - and --latex - would mix on standard output; give one of them a file"
        )
    taken = {os.path.realpath(path): f"{option} {path}" for option, path in inputs}
    for option, path in (
        ("--out", out),
        ("--json", json),
        ("--latex", latex),
        ("--episodes-out", episodes_out),
        ("--plot", plot),
    ):
        if path is None or (option in ("--json", "--latex") and path == STDOUT):
            continue
        require_writable(path)
        place = os.path.realpath(path)
        if place in taken:
            raise ConfigurationError(
                f"{option} {path} would overwrite the file of {taken[place]}; name another file"
            )
        taken[place] = f"{option} {path}"
    if episodes_out is not None:
        from safe_envs.agents.evaluation.episodes_file import require_parquet

        require_parquet(episodes_out, "--episodes-out")
    if plot is not None:
        _require_format(plot)


def _require_format(path: Path) -> None:
    """Raise ConfigurationError unless the suffix of a path names a format that can be drawn."""
    suffix = path.suffix.removeprefix(".").lower()
    if suffix not in PLOT_FORMATS:
        raise ConfigurationError(
            f"--plot {path}: unknown format {shown(suffix)}; {nearest(suffix, PLOT_FORMATS)}"
        )


def inputs_of(
    system: str | None,
    policy: str = "nominal",
    filters: Iterable[str] = (),
    learned: Iterable[Path] = (),
    filter_spec: str | None = None,
) -> Iterator[tuple[str, Path]]:
    """Yield the files that a command may read, each with its option.

    Args:
        system: of --system, FILE.py:NAME.
        policy: of --policy.
        filters: of --filter, with file=FILE.
        learned: of --learned.
        filter_spec: of --filter-spec, FILE.py:NAME.

    Returns:
        Pairs of option and file.
    """
    from safe_envs.agents.policies.names import policy_files

    for option, place in (("--system", system), ("--filter-spec", filter_spec)):
        source = (place or "").rpartition(":")[0]
        # Anything else is the name of a module.
        if source.endswith(".py"):
            yield option, Path(source)
    for file in policy_files(policy):
        yield "--policy", file
    for path in learned:
        yield "--learned", path
    for name in filters:
        for text in re.findall("file=([^:]+)", name):
            # A plus sign may be in the file's name, or come before the next condition.
            parts = text.split("+")
            yield from (("--filter", Path("+".join(parts[: i + 1]))) for i in range(len(parts)))
