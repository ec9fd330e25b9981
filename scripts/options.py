"""The options that say which env is meant, and from their text to the arguments of `gym.make`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from safe_envs.errors import ConfigurationError
from safe_envs.files import require_writable
from scripts import completion
from scripts.console import STDOUT

EnvId = Annotated[
    str | None,
    typer.Argument(
        metavar="[ENV_ID]", help="Registered id; `safe-envs list` shows all.", show_default=False, autocompletion=completion.env_ids
    ),
]
System = Annotated[
    str | None,
    typer.Option(
        metavar="FILE.py:NAME", help="In place of ENV_ID: a SafetyProblem of your own or a function that returns one. Runs the file."
    ),
]
Noise = Annotated[
    str | None, typer.Option(metavar="X", help="Diffusion, one number for all channels or one for each (.1,.2); 0 turns it off.")
]
Plant = Annotated[list[str] | None, typer.Option(metavar="K=V", help="Parameter of the simulated system. Repeatable.")]
Model = Annotated[list[str] | None, typer.Option(metavar="K=V", help="Parameter that the designer believes. Repeatable.")]
BarrierArguments = Annotated[list[str] | None, typer.Option(metavar="K=V", help="Argument of the barrier. Repeatable.")]
Knowledge = Annotated[str, typer.Option(metavar="model|plant", help="What the filters know.")]
Dt = Annotated[float | None, typer.Option(help="Control period in s.")]
Substeps = Annotated[int | None, typer.Option(help="Integration steps in a control period.")]
Horizon = Annotated[float | None, typer.Option(help="Length of an episode in s.")]
Box = Annotated[list[str] | None, typer.Option(metavar="LO,HI", help="Physical bounds of all inputs, or once for each.")]
StartAt = Annotated[str | None, typer.Option(metavar="A,B,..", help="Initial state, or the name of a distribution.")]
Trust = Annotated[
    bool, typer.Option("--trust", help="Load the .zip of --policy. That runs code that it contains: only for files whose source you trust.")
]
Seed = Annotated[int, typer.Option(help="Seed of all randomness.")]
FORMATS = ".png, .pdf, .svg, or another format of matplotlib."


def of_env(
    *,
    system: str | None,
    noise: str | None,
    plant: Sequence[str] | None,
    model: Sequence[str] | None,
    barrier: Sequence[str] | None,
    dt: float | None,
    substeps: int | None,
    horizon: float | None,
    box: Sequence[str] | None,
    start: str | None,
) -> dict[str, Any]:
    """The arguments of `gym.make` that the options of the same names stand for.

    Raises:
        ConfigurationError: a text cannot be read.
    """
    return {
        **({} if system is None else {"system": system}),
        "noise": read_noise(noise),
        "plant": parameters("--plant", plant or ()),
        "model": parameters("--model", model or ()),
        "barrier": parameters("--barrier", barrier or (), words=True),
        "dt": dt,
        "substeps": substeps,
        "horizon": horizon,
        "box": read_box(box or ()),
        "start": read_start(start),
    }


def numbers(option: str, text: str) -> list[float]:
    """Read "1,2.5,-3".

    Raises:
        ConfigurationError: an entry is no number.
    """
    try:
        return [float(entry) for entry in text.split(",")]
    except ValueError as error:
        raise ConfigurationError(f"{option} {text!r} is no number or list of numbers with commas between") from error


def require_outputs(json: Path | None, plot: Path | None, *, out: Path | None = None, inputs: Iterable[tuple[str, Path]] = ()) -> None:
    """Check, before any work, that --out, --json and --plot can be written, each to a file of its own.

    Args:
        json: of --json, if given.
        plot: of --plot, if given.
        out: of --out, where a command has it.
        inputs: options and the files that they read, which are not to be overwritten.

    Raises:
        ConfigurationError: one cannot.
    """
    taken = {path.resolve(): f"{option} {path}" for option, path in inputs}
    for option, path in (("--out", out), ("--json", json), ("--plot", plot)):
        if path is None or (option == "--json" and path == STDOUT):
            continue
        require_writable(path)
        place = path.resolve()
        if place in taken:
            raise ConfigurationError(f"{option} {path} would overwrite the file of {taken[place]}; name another file")
        taken[place] = f"{option} {path}"
    if plot is not None:
        from scripts.figure import require_format

        require_format(plot)


def inputs_of(policy: str, filters: Iterable[str], learned: Iterable[Path] = ()) -> Iterator[tuple[str, Path]]:
    """Options and the files that a simulation may read: of a policy, of filters with file=FILE, and of --learned."""
    from agents.policy import policy_files

    for path in policy_files(policy):
        yield "--policy", path
    for path in learned:
        yield "--learned", path
    for name in filters:
        for text in re.findall("file=([^:]+)", name):
            # A plus sign may be in the file's name, or come before the next condition.
            parts = text.split("+")
            yield from (("--filter", Path("+".join(parts[: i + 1]))) for i in range(len(parts)))


def read_noise(text: str | None) -> float | list[float] | None:
    """Read --noise: one number for all channels, or one for each."""
    if text is None:
        return None
    levels = numbers("--noise", text)
    return levels[0] if len(levels) == 1 else levels


def read_start(text: str | None) -> str | list[float] | None:
    """Read --start: a state, or else the name of a distribution."""
    if text is None:
        return None
    try:
        return numbers("--start", text)
    except ConfigurationError:
        if "," in text:
            raise
        return text


def read_box(texts: Sequence[str]) -> list[float] | list[list[float]] | None:
    """Read --box LO,HI: one for all inputs, or one for each.

    Raises:
        ConfigurationError: an entry is not two numbers.
    """
    pairs = [numbers("--box", text) for text in texts]
    for text, pair in zip(texts, pairs, strict=True):
        if len(pair) != 2:
            raise ConfigurationError(f"--box {text!r} has {len(pair)} numbers; give LO,HI")
    if len(pairs) == 1:
        return pairs[0]
    return pairs or None


def parameters(option: str, texts: Sequence[str], words: bool = False) -> dict[str, Any] | None:
    """Read NAME=VALUE entries.

    Args:
        option: which is read.
        texts: the entries.
        words: whether a value may be a word.

    Raises:
        ConfigurationError: an entry has no name, comes twice, or its value is no number where it must be one.
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not name or not equals or not value or name in found:
            problem = "comes twice" if name in found else "is not of this form"
            raise ConfigurationError(f"{option} {text!r} {problem}; give NAME=VALUE, once for each parameter")
        found[name] = _value(option, text, value, words)
    return found or None


def _value(option: str, text: str, value: str, words: bool) -> float | str:
    try:
        return int(value) if value.lstrip("+-").isdecimal() else float(value)
    except ValueError as error:
        if words:
            return value
        raise ConfigurationError(f"{option} {text!r}: {value!r} is not a number") from error
