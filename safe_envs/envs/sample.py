"""What has arrived from a sensor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np


class Sample(NamedTuple):
    """What has arrived from a sensor up to a control instant.

    Attributes:
        values: k components: floats of one env, or arrays (num_envs,) of a batch. Where nothing
            arrived at this instant, the last value that did.
        received: which arrived at this instant, bools or arrays of them.
    """

    values: Sequence[Any]
    received: Sequence[Any]


def read_only(components: Sequence[Any]) -> tuple[Any, ...]:
    """Return components that others may read, and not write to.

    Args:
        components: arrays.
    """
    found = tuple([np.asarray(component).view() for component in components])
    for component in found:
        component.flags.writeable = False
    return found


def merged(where: np.ndarray, one: Sample, other: Sample) -> Sample:
    """Return samples of a batch that are one in some envs and another elsewhere.

    Args:
        where: bool (num_envs,).
        one: of the envs where it is True.
        other: of the others.
    """
    return Sample(
        *(
            [np.where(where, a, b) for a, b in zip(*pair, strict=True)]
            for pair in zip(one, other, strict=True)
        )
    )
