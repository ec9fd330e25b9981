"""Networks as functions of compiled programs."""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate
from typing import Any

import numpy as np

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source
from safe_envs.wrappers.learning.models import network_kernel
from safe_envs.wrappers.learning.models.network import Network


def network_source(network: Network, name: str, data: Data) -> Source:
    """Return a function `name(inputs, data, work)` of p inputs, which returns q outputs.

    They are those of `Network.floats`, up to rounding: a matrix product of NumPy adds up in another
    order.

    Args:
        network: with any activation.
        name: of the function.
        data: receives the weights.
    """
    layers = _Layers(network, data)
    layers.forward(len(network.layers))
    return layers.source(name, layers.places[-1], layers.sizes[-1])


def slopes_source(network: Network, name: str, data: Data, output: int) -> Source:
    """Return a function `name(inputs, data, work)` of p inputs, which returns p slopes.

    They are those of `Network.values_and_slopes_floats`, up to rounding; see `network_source`.

    Args:
        network: with an activation of those that are trained here.
        name: of the function.
        data: receives the weights.
        output: index k of the output to differentiate.
    """
    layers = _Layers(network, data)
    layers.forward(len(network.layers) - 1)
    return layers.source(name, layers.backward(output), layers.sizes[0])


class _Layers:
    """Calls of kernels, layer by layer.

    Attributes:
        sizes: numbers before the first layer and after each.
        places: where they stand in the scratch array.
    """

    def __init__(self, network: Network, data: Data) -> None:
        self._network, self._data = network, data
        self.sizes = [network.layers[0][0].shape[1], *(len(b) for _, b in network.layers)]
        *self.places, self._end = accumulate(self.sizes, initial=0)
        self._lines = ["set_network_inputs(inputs, work)"]
        self._uses: list[Callable[..., Any]] = [network_kernel.set_network_inputs]

    def _call(self, kernel: Callable[..., Any], *numbers: int, data: str = "") -> None:
        self._lines.append(f"{kernel.__name__}({', '.join(map(str, numbers))}, {data}work)")
        self._uses.append(kernel)

    def _set(self, y: int, values: np.ndarray) -> None:
        self._call(
            network_kernel.copy_layer_numbers, y, len(values), self._data.add(values), data="data, "
        )

    def _add_products(self, x: int, y: int, matrix: np.ndarray) -> None:
        place = self._data.add(matrix.ravel())
        count, size = matrix.shape
        self._call(network_kernel.add_layer_products, x, count, y, size, place, data="data, ")

    def forward(self, count: int) -> None:
        """Evaluate the first layers."""
        activation = getattr(network_kernel, f"{self._network.activation}_units", None)
        for k, (weights, bias) in enumerate(self._network.layers[:count], start=1):
            self._set(self.places[k], bias)
            self._add_products(self.places[k - 1], self.places[k], weights.T)
            # The identity has no kernel.
            if activation is not None and k < len(self._network.layers):
                self._call(activation, self.places[k], self.sizes[k])

    def backward(self, output: int) -> int:
        """Differentiate an output, from the last layer on; return where the slopes stand."""
        slopes = getattr(network_kernel, f"{self._network.activation}_slopes")
        s = self._end
        self._set(s, self._network.layers[-1][0][output])
        for k in range(len(self._network.layers) - 1, 0, -1):
            self._call(slopes, self.places[k], s, self.sizes[k])
            t = s + self.sizes[k]
            self._call(network_kernel.clear_layer, t, self.sizes[k - 1])
            self._add_products(s, t, self._network.layers[k - 1][0])
            s = t
        self._end = s + self.sizes[0]
        return s

    def source(self, name: str, place: int, count: int) -> Source:
        """Return the function that makes the calls and returns numbers from a place on."""
        entries = "".join(f"work[{place + i}], " for i in range(count))
        lines = "".join(f"    {line}\n" for line in self._lines)
        return Source(
            f"def {name}(inputs, data, work):\n{lines}    return ({entries})\n",
            tuple(self._uses),
            self._end,
        )
