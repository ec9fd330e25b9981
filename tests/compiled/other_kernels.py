"""A kernel with the name of another one."""

from __future__ import annotations


def scaled(values: tuple[float, ...]) -> float:
    return values[0]
