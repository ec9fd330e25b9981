"""Options of several commands, and from the text of options to arguments."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from safe_envs.atomic_io import require_writable
from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.number_text import real, whole_or_real
from safe_envs.scripts.options.console import STDOUT

Knowledge = Annotated[str, typer.Option(metavar="model|plant", help="What the filters know.")]
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
Seed = Annotated[int, typer.Option(help="Seed of all randomness.")]
FORMATS = ".png, .pdf, .svg, or another format of matplotlib."


def numbers(option: str, text: str) -> list[float]:
    """Read "1,2.5,-3".

    Raises:
        ConfigurationError: an entry is no number.
    """
    try:
        return [real(entry) for entry in text.split(",")]
    except ValueError as error:
        raise ConfigurationError(
            f"{option} {shown(text)} is no number or list of numbers with commas between"
        ) from error


def require_outputs(
    json: Path | None,
    plot: Path | None,
    *,
    out: Path | None = None,
    inputs: Iterable[tuple[str, Path]] = (),
) -> None:
    """Check, before any work, that --out, --json and --plot can be written, each to a file of its
    own.

    Args:
        json: of --json, if given.
        plot: of --plot, if given.
        out: of --out, where a command has it.
        inputs: options and the files that they read, which are not to be overwritten.

    Raises:
        ConfigurationError: one cannot.
    """
    taken = {os.path.realpath(path): f"{option} {path}" for option, path in inputs}
    for option, path in (("--out", out), ("--json", json), ("--plot", plot)):
        if path is None or (option == "--json" and path == STDOUT):
            continue
        require_writable(path)
        place = os.path.realpath(path)
        if place in taken:
            raise ConfigurationError(
                f"{option} {path} would overwrite the file of {taken[place]}; name another file"
            )
        taken[place] = f"{option} {path}"
    if plot is not None:
        _require_format(plot)


def _require_format(path: Path) -> None:
    """Raise ConfigurationError unless the suffix of a path names a format that can be drawn."""
    # Not imported before it is needed: completion has to be quick.
    from matplotlib.backend_bases import FigureCanvasBase

    # pgf is left out: it needs a TeX installation.
    formats = sorted(set(FigureCanvasBase.get_supported_filetypes()) - {"pgf"})
    suffix = path.suffix.removeprefix(".").lower()
    if suffix not in formats:
        raise ConfigurationError(
            f"--plot {path}: unknown format {shown(suffix)}; {nearest(suffix, formats)}"
        )


def inputs_of(
    system: str | None,
    policy: str = "nominal",
    filters: Iterable[str] = (),
    learned: Iterable[Path] = (),
    filter_spec: str | None = None,
) -> Iterator[tuple[str, Path]]:
    """Options and the files that a command may read: of FILE.py:NAME, of a policy, of --learned,
    and of filters with file=FILE."""
    from safe_envs.agents.policies.registry import policy_file

    for option, place in (("--system", system), ("--filter-spec", filter_spec)):
        source = (place or "").rpartition(":")[0]
        # Anything else is the name of a module.
        if source.endswith(".py"):
            yield option, Path(source)
    file = policy_file(policy)
    if file is not None:
        yield "--policy", file
    for path in learned:
        yield "--learned", path
    for name in filters:
        for text in re.findall("file=([^:]+)", name):
            # A plus sign may be in the file's name, or come before the next condition.
            parts = text.split("+")
            yield from (("--filter", Path("+".join(parts[: i + 1]))) for i in range(len(parts)))


def read_noise(text: str) -> float | list[float]:
    """Read --noise: one number for all channels, or one for each."""
    levels = numbers("--noise", text)
    return levels[0] if len(levels) == 1 else levels


def read_start(text: str) -> str | list[float]:
    """Read --start: a state, or else the name of a distribution."""
    try:
        return numbers("--start", text)
    except ConfigurationError:
        if "," in text:
            raise
        return text


def read_box(texts: Sequence[str]) -> list[float] | list[list[float]]:
    """Read --box LO,HI: one for all inputs, or one for each.

    Raises:
        ConfigurationError: an entry is not two numbers.
    """
    pairs = [numbers("--box", text) for text in texts]
    for text, pair in zip(texts, pairs, strict=True):
        if len(pair) != 2:
            raise ConfigurationError(f"--box {shown(text)} has {len(pair)} numbers; give LO,HI")
    return pairs[0] if len(pairs) == 1 else pairs


def parameters(option: str, texts: Sequence[str], words: bool = False) -> dict[str, Any]:
    """Read NAME=VALUE entries.

    Args:
        option: which is read.
        texts: the entries.
        words: whether a value may be a word.

    Raises:
        ConfigurationError: an entry has no name, comes twice, or its value is no number where it
            must be one.
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not name or not equals or not value or name in found:
            problem = "comes twice" if name in found else "is not of this form"
            raise ConfigurationError(
                f"{option} {shown(text)} {problem}; give NAME=VALUE, once for each parameter"
            )
        found[name] = _value(option, text, value, words)
    return found


def _value(option: str, text: str, value: str, words: bool) -> float | str:
    try:
        return whole_or_real(value)
    except ValueError as error:
        if words:
            return value
        raise ConfigurationError(
            f"{option} {shown(text)}: {shown(value)} is not a number"
        ) from error
