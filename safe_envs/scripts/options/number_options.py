"""Options that take a number, read by the project's one reader of numbers."""

from __future__ import annotations

import copy
import inspect
import typing
from collections.abc import Callable
from typing import Annotated, Any

import typer

from safe_envs.errors import shown
from safe_envs.number_text import whole_or_real


def strict(parameter: inspect.Parameter) -> inspect.Parameter:
    """Return the parameter of a command, with the project's reader if it is a number.

    Typer itself accepts all that Python does: digits of other scripts, and 1_000.
    """
    if typing.get_origin(parameter.annotation) is not Annotated:
        return parameter
    hint, option, *_ = typing.get_args(parameter.annotation)
    kind = next((kind for kind in (int, float) if kind in (hint, *typing.get_args(hint))), None)
    if kind is None:
        return parameter
    found = copy.copy(option)
    found.parser = _reader(kind, option.min)
    found.metavar = option.metavar or ("INTEGER" if kind is int else "FLOAT")
    return parameter.replace(annotation=Annotated[hint, found])


def _reader(kind: type[int] | type[float], least: float | None) -> Callable[[Any], int | float]:
    what = "a whole number" if kind is int else "a number"

    def read(text: Any) -> int | float:
        try:
            # A default is a number already.
            number = whole_or_real(text) if isinstance(text, str) else text
        except ValueError:
            number = None
        if number is None or (kind is int and not isinstance(number, int)):
            raise typer.BadParameter(f"= {shown(text)}; give {what}")
        if least is not None and number < least:
            raise typer.BadParameter(f"= {shown(number)}; give {what} from {least}")
        return kind(number)

    return read
