"""The info of one env of a batch, made from the batch's arrays as it is read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any

import numpy as np

_get = dict.get


class LazyInfo(dict[str, Any]):
    """A dict like the scalar env's info, whose entries are made when they are first read.

    Reading a key makes its entry, with the type that the scalar env reports; whatever looks at all
    keys (iteration, `items`, `==`, ...) makes all. A `copy()` stays lazy and keeps `batch` and
    `index`; a pickle or a deep copy is a plain dict of this env's entries. Two are equal if their
    entries are, and arrays if all their elements are.

    Give `json.dumps` a `dict(info)`: its C code takes an info of which no array was read yet for
    empty, and writes "{}".

    Attributes:
        batch: arrays by key, with the batch in front; the infos of a step share them, so read only.
        index: of the env in the batch.

    Args:
        batch: see above; arrays that are not changed any more.
        index: see above.
    """

    __slots__ = ("_left", "batch", "index")

    def __init__(self, batch: Mapping[str, np.ndarray], index: int) -> None:
        self.batch = self._left = batch
        self.index = index

    def __missing__(self, key: str) -> Any:
        values = self._left[key]
        if values.ndim == 1:
            # It is quicker to make a number again than to keep it, which learners read once.
            return values.item(self.index)
        row = self[key] = values[self.index].copy()
        return row

    def __contains__(self, key: object) -> bool:
        return key in self._left or dict.__contains__(self, key)

    def get(self, key: str, default: Any = None) -> Any:
        """Return an entry, or the default if there is none.

        Args:
            key: of the entry.
            default: in its place.
        """
        return self[key] if key in self._left else _get(self, key, default)

    def copy(self) -> LazyInfo:
        """Return an info with the same entries, as lazy as this one."""
        # VecMonitor copies the info of each env that is done: a callback should find `batch` there
        # as well.
        twin = LazyInfo(self.batch, self.index)
        twin._left = self._left
        # What is made already and no more, unlike `twin.update(self)`.
        twin.update(dict.items(self))
        return twin

    __copy__ = copy

    def __reduce__(self) -> tuple[type[dict[str, Any]], tuple[dict[str, Any]]]:
        return dict, (dict(self),)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, dict):
            return NotImplemented
        mine, theirs = dict(self), dict(other)
        return mine.keys() == theirs.keys() and all(
            _same(value, theirs[key]) for key, value in mine.items()
        )

    def __ne__(self, other: object) -> bool:
        equal = self == other
        return not equal

    def make_all(self) -> None:
        """Make the entries that were not read yet."""
        for key in self._left:
            self[key] = self[key]
        # What is deleted from now on stays away.
        self._left = {}


def of_each(infos: Sequence[Any], key: str) -> np.ndarray | list[Any]:
    """Return an entry of every info: an array if they are views of one batch, or a list.

    Args:
        infos: any; those that have `batch`, a dict of arrays over the envs, and `index`, their row
            in them, are read at once, unless the entry of one was written to.
        key: of the entry, for which the list has None where it is missing.
    """
    batch = getattr(infos[0], "batch", None)
    if (
        batch is None
        or key not in batch
        or any(getattr(info, "batch", None) is not batch for info in infos)
        or any(dict.__contains__(info, key) for info in infos)
    ):
        return [info.get(key) for info in infos]
    return batch[key][[info.index for info in infos]]


def of_envs(infos: Any, num_envs: int) -> Sequence[Any]:
    """Return the infos of a step of every env, also those of a vector env of Gymnasium.

    Args:
        infos: a sequence, which is returned; or a mapping of arrays over the envs with their masks.
            There the info of an env whose episode ended is in `final_info`.
        num_envs: number of the envs.
    """
    if not isinstance(infos, Mapping):
        return infos
    rows: list[dict[str, Any]] = [{} for _ in range(num_envs)]
    # Of an ended episode the last step counts, and not the reset after it.
    for part in (infos, infos.get("final_info") or {}):
        for key, values in part.items():
            if not isinstance(values, np.ndarray) or len(values) != num_envs or key[0] == "_":
                continue
            for i in np.flatnonzero(part.get(f"_{key}", np.ones(num_envs, dtype=bool))).tolist():
                rows[i][key] = values[i]
    return rows


def _same(a: Any, b: Any) -> bool:
    return (
        np.array_equal(a, b)
        if isinstance(a, np.ndarray) or isinstance(b, np.ndarray)
        else a is b or a == b
    )


def _after_making_all(name: str) -> Callable[..., Any]:
    of_dict = getattr(dict, name)

    @wraps(of_dict)
    def method(self: LazyInfo, *arguments: Any) -> Any:
        self.make_all()
        return of_dict(self, *arguments)

    return method


_OF_ALL_KEYS = ("keys", "values", "items", "pop", "popitem", "setdefault", "clear")
_OF_ALL_KEYS += (
    "__iter__",
    "__reversed__",
    "__len__",
    "__or__",
    "__ror__",
    "__repr__",
    "__delitem__",
)
for _name in _OF_ALL_KEYS:
    setattr(LazyInfo, _name, _after_making_all(_name))
