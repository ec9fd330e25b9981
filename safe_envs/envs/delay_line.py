"""Inputs on their way from the sender to the plant, of one env or of a batch."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safe_envs.envs.info import Info
from safe_envs.problem.actuators import Limits, resting_input
from safe_envs.problem.problem import SafetyProblem


class DelayLine:
    """The inputs that are under way: what goes in comes out `delay` control periods later.

    Inputs are components: floats of one env, or arrays (num_envs,) of a batch. Before the first
    arrives, the resting input comes out.

    Attributes:
        under_way: the inputs that were sent and not executed yet, the oldest first.

    Args:
        delay: whole control periods, 0 for none.
        rest: the resting input, m floats.
        num_envs: size of a batch; None for one env.
    """

    def __init__(self, delay: int, rest: Sequence[float], num_envs: int | None = None) -> None:
        self._rest = tuple(rest)
        self._num_envs = num_envs
        self.under_way: deque[tuple[Any, ...]] = deque([self.rest] * delay)

    @property
    def rest(self) -> tuple[Any, ...]:
        """The components of the resting input, of every env."""
        if self._num_envs is None:
            return self._rest
        return tuple([np.full(self._num_envs, u) for u in self._rest])

    def exchange(self, u: Sequence[Any]) -> tuple[Any, ...]:
        """Send an input, and return the one that arrives in the same control period."""
        # What others do to their arrays must not reach what is under way.
        own = tuple(u) if self._num_envs is None else tuple([np.array(c, dtype=float) for c in u])
        self.under_way.append(own)
        return self.under_way.popleft()

    def restart(self, envs: np.ndarray | None = None) -> None:
        """Put resting inputs in the place of those under way.

        Args:
            envs: whose, indices or a mask; None for all.
        """
        rest = self.rest
        self.under_way = deque(
            [rest if envs is None else _replaced(u, rest, envs) for u in self.under_way]
        )

    def snapshot(self) -> np.ndarray:
        """Return the inputs under way, shape (num_envs, delay, m); of one env (delay, m)."""
        shape = () if self._num_envs is None else (self._num_envs,)
        found = np.array([np.stack(u, axis=-1) for u in self.under_way], dtype=float)
        return np.moveaxis(found.reshape(len(self.under_way), *shape, len(self._rest)), 0, -2)

    def restore(self, snapshot: np.ndarray) -> None:
        """Take the inputs under way from a snapshot."""
        values = np.moveaxis(np.array(snapshot, dtype=float), (-2, -1), (0, 1))
        self.under_way = deque(
            [tuple(u.tolist() if self._num_envs is None else list(u)) for u in values]
        )


class Actuators:
    """What executes the inputs that are sent: after a delay, and with limited rates.

    In each control period the input that arrives is the command u_c; executed is u_c, or with rates
    within [r-, r+] what is nearest to it in [u + dt r-, u + dt r+], where u was executed before.

    Attributes:
        sent: components of the input that was sent last.
        executed: components of the one that was executed last.

    Args:
        problem: with the delay and the rates.
        num_envs: size of a batch; None for one env.
    """

    def __init__(self, problem: SafetyProblem, num_envs: int | None = None) -> None:
        rest = resting_input(problem.box)
        self._line = DelayLine(problem.delay, rest, num_envs)
        self._steps: Limits = tuple(
            (problem.dt * low, problem.dt * high) for low, high in problem.slew_limit
        )
        self._batch = num_envs is not None
        self.sent = self.executed = self._line.rest

    def execute(self, u: Sequence[Any]) -> Sequence[Any]:
        """Send an input, and return the one that is executed in the same control period."""
        self.sent = tuple(u)
        command = self._line.exchange(u)
        if self._steps:
            clipped = np.clip if self._batch else _clipped
            command = tuple(
                [
                    clipped(c, last + down, last + up)
                    for c, last, (down, up) in zip(command, self.executed, self._steps, strict=True)
                ]
            )
        self.executed = command
        return command

    def restart(self, envs: np.ndarray | None = None) -> None:
        """Begin episodes, at rest.

        Args:
            envs: in which, indices or a mask; None for all.
        """
        self._line.restart(envs)
        rest = self._line.rest
        self.sent, self.executed = (
            rest if envs is None else _replaced(u, rest, envs) for u in (self.sent, self.executed)
        )

    def report(self) -> Info:
        """Return what they add to the info; see `safe_envs.envs.info`."""
        return {
            "sent_action": np.stack(self.sent, axis=-1),
            "executed_action": np.stack(self.executed, axis=-1),
        }

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the inputs under way, sent last and executed last, in arrays."""
        return {"inputs_under_way": self._line.snapshot(), **self.report()}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Take them from a snapshot."""
        self._line.restore(snapshot["inputs_under_way"])
        self.sent, self.executed = (
            tuple(values.T.copy() if self._batch else values.tolist())
            for key in ("sent_action", "executed_action")
            for values in (np.array(snapshot[key], dtype=float),)
        )


def _clipped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def _replaced(u: Sequence[Any], other: Sequence[Any], envs: np.ndarray) -> tuple[Any, ...]:
    """Return components with those of other inputs in some envs."""
    found = tuple([np.array(c, dtype=float) for c in u])
    for c, o in zip(found, other, strict=True):
        c[envs] = o[envs]
    return found
