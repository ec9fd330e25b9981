"""A dict that does not change."""

from __future__ import annotations

from typing import Any, NoReturn, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class FixedDict(dict[K, V]):
    """A dict whose entries stay as they are: for what is hashed, or compiled into formulas.

    It is equal to a dict with these entries, and can be pickled and copied.
    """

    def _refuse(self, *given: Any, **named: Any) -> NoReturn:
        raise TypeError(f"{dict(self)} does not change; make another system, of a changed copy")

    __setitem__ = __delitem__ = __ior__ = _refuse  # pyright: ignore
    update = setdefault = pop = popitem = clear = _refuse  # pyright: ignore

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (dict(self),)

    def __copy__(self) -> FixedDict[K, V]:
        return self
