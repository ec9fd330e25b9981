"""One control period of a system: Euler-Maruyama with noise, classical Runge-Kutta without."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, Flavour, compile_function, constants
from safe_envs.dynamics.sde import ControlAffineSDE


class Integrator:
    """Advances a system by dt under a constant input.

    Noise channels whose diffusion is zero are left out, and a system without any is integrated by
    RK4: an Euler step would leak out of sets that the theory keeps.

    Attributes:
        channels: number of standard normal draws for a control period (0 without noise).
    """

    def __init__(
        self, system: ControlAffineSDE, dt: float, substeps: int, flavour: Flavour
    ) -> None:
        self._substeps = substeps
        h = dt / substeps
        factors = (0.5 * h, h, h / 6.0, 2.0)
        self._factors: Sequence[Any] = constants(factors) if flavour == "arrays" else factors
        self._wiener, function = _compiled(system, h, flavour)
        self.channels = self._wiener * substeps
        self._euler = self._rate = function

    def step(
        self, x: Components, u: Sequence[Any], draws: Sequence[Any] | np.ndarray
    ) -> Components:
        """Return the components of the state one control period later.

        Args:
            x: n components of the state.
            u: m components of the physical input.
            draws: `channels` standard normal components, substep by substep.
        """
        if self._wiener:
            for k in range(0, self.channels, self._wiener):
                x = self._euler(*x, *u, *draws[k : k + self._wiener])
            return x
        for _ in range(self._substeps):
            x = self._runge_kutta(x, u)
        return x

    def _runge_kutta(self, x: Components, u: Sequence[Any]) -> Components:
        rate = self._rate
        half, h, sixth, two = self._factors
        k1 = rate(*x, *u)
        k2 = rate(*[a + half * b for a, b in zip(x, k1, strict=True)], *u)
        k3 = rate(*[a + half * b for a, b in zip(x, k2, strict=True)], *u)
        k4 = rate(*[a + h * b for a, b in zip(x, k3, strict=True)], *u)
        return tuple(
            a + sixth * (b1 + two * (b2 + b3) + b4)
            for a, b1, b2, b3, b4 in zip(x, k1, k2, k3, k4, strict=True)
        )


@lru_cache(maxsize=128)
def _compiled(
    system: ControlAffineSDE, h: float, flavour: Flavour
) -> tuple[int, Callable[..., Components]]:
    """Compile a step of h in s, or the rate where there is no noise, with the noise channels."""
    arguments = (*system.states, *system.inputs)
    if not system.noise_channels:
        return 0, compile_function(arguments, tuple(rate(system)), flavour)
    draws, moved = euler_maruyama_step(system, h)
    return len(draws), compile_function((*arguments, *draws), tuple(moved), flavour)


def rate(system: ControlAffineSDE) -> Any:
    """Return f + g u with the values of the parameters, a matrix (n, 1)."""
    return system.numeric(system.drift + system.input_matrix * sp.Matrix(system.inputs))


def euler_maruyama_step(system: ControlAffineSDE, h: float) -> tuple[tuple[sp.Symbol, ...], Any]:
    """Derive a step of Euler and Maruyama.

    Args:
        system: with noise.
        h: length of the step in s.

    Returns:
        Symbols of the standard normals that it takes, and the state after it, a matrix (n, 1).
    """
    live = list(system.noise_channels)
    draws = sp.symbols(f"_w:{len(live)}", real=True)
    diffusion = system.numeric(system.diffusion)[:, live]
    noise = diffusion * sp.Matrix(draws) * sp.Float(math.sqrt(h), 17)
    return draws, sp.Matrix(system.states) + rate(system) * sp.Float(h, 17) + noise
