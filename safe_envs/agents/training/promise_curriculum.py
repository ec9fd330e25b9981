"""A promise filter in a training, which begins with a lower probability and raises it.

Early on a filter that keeps a lower probability lets the agent do more, and so see more of what its
actions lead to. The probability rises linearly to that of the filter; each episode keeps the one
with which it began, so that its guarantee is that of p_0 = min(p(t), max q_0).
"""

from __future__ import annotations

import numbers
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.conditions.text_parts import names_promise
from safe_envs.wrappers.value.promise_text import PromiseSettings

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


@dataclass(frozen=True)
class PromiseCurriculum:
    """What probability the episodes that begin after some steps are kept safe with.

    Attributes:
        first: probability at the beginning.
        last: that of the filter.
        steps: over which it rises.
    """

    first: float
    last: float
    steps: float

    @classmethod
    def of(
        cls, first: Any, part: Any, text: str | None, n_timesteps: int
    ) -> PromiseCurriculum | None:
        """Return the curriculum of a training, or None without one.

        Args:
            first: probability at the beginning; None without a curriculum.
            part: of the training over which it rises, up to 1.
            text: of the filter in the loop.
            n_timesteps: of the training.

        Raises:
            ConfigurationError: there is no promise filter, or a number is out of range.
        """
        if not _is_number(part) or not 0.0 < part <= 1.0:
            raise ConfigurationError(
                f"curriculum_part = {part!r}; give the part of the training over which p rises,"
                " above 0 and up to 1"
            )
        if first is None:
            return None
        if text is None or not names_promise(text):
            raise ConfigurationError(
                f"a curriculum on p is for a promise filter in the loop, and the filter is"
                f" {text or 'none'}; give --filter promise:p=0.99, or no --promise-curriculum"
            )
        last = PromiseSettings.of_text(text).probability
        if not _is_number(first) or not 0.0 < first < last:
            raise ConfigurationError(
                f"promise_curriculum = {first!r}; give the probability at the beginning, between 0"
                f" and the filter's {last:g}"
            )
        return cls(float(first), last, part * n_timesteps)

    def at(self, done: int) -> float:
        """Return the probability after some steps of the training."""
        share = min(done / self.steps, 1.0)
        # Rounding is not to exceed what the filter was made for.
        return min((1.0 - share) * self.first + share * self.last, self.last)

    def ask(self, envs: VecEnv, done: int) -> float:
        """Tell the filter of the envs, and return the probability; see `at`."""
        p = self.at(done)
        envs.env_method("ask_promise", p)
        return p


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)
