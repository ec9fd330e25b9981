"""Settings of the synthesis of a barrier."""

from __future__ import annotations

import math
from dataclasses import dataclass

from safe_envs.errors import ConfigurationError, require_whole, shown

_MOST_DEGREE = 20


@dataclass(frozen=True)
class SynthesisSettings:
    """How a polynomial barrier is looked for.

    Attributes:
        degrees: total degrees of psi that are tried, in increasing order, after the lower ones of
            those that suit the number of states; () for these, as long as each is better.
        rates: a of the bound, each >= 0, in 1/s; () for 0 and some in proportion to 1/T.
        rounds: linear programs of a degree, at most, each with the states added at which the one
            before is violated.
        starts: initial states over which the bound is averaged in the linear programs.
        tolerance: part of the bound that violations between the sampled states may cost.
        seconds: after which no other degree is begun.
        seed: of all draws.

    Raises:
        ConfigurationError: A degree, a rate or a number is out of range.
    """

    degrees: tuple[int, ...] = ()
    rates: tuple[float, ...] = ()
    rounds: int = 16
    starts: int = 4000
    tolerance: float = 2e-3
    seconds: float = 25.0
    seed: int = 0

    def __post_init__(self) -> None:
        for degree in self.degrees:
            require_whole("degree", degree, 1)
            if degree > _MOST_DEGREE:
                raise ConfigurationError(
                    f"degree = {degree}; polynomials up to degree {_MOST_DEGREE} are looked for:"
                    " linear programs of higher ones are too ill-conditioned"
                )
        for rate in self.rates:
            if not 0.0 <= rate < math.inf:
                raise ConfigurationError(
                    f"rate = {shown(rate)} 1/s; give a finite number of at least 0, since a bound"
                    " does not hold for a negative one"
                )
        require_whole("rounds", self.rounds, 1)
        require_whole("starts", self.starts, 1)
        require_whole("seed", self.seed, 0)
        if not 0.0 < self.tolerance < 1.0 or not self.seconds > 0.0:
            raise ConfigurationError(
                f"tolerance = {shown(self.tolerance)} and seconds = {shown(self.seconds)}; the"
                " tolerance is in (0, 1), the seconds are above 0"
            )
