"""A small network, of a learned model or a policy: its outputs and slopes in NumPy alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any, Literal, get_args

import numpy as np

from safe_envs.dynamics.codegen import finite
from safe_envs.engine.formulas import Source
from safe_envs.engine.slots import Data
from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.filters.learning.models import network_kernel

Activation = Literal["relu", "tanh"]
"""Of the networks that are trained here, whose slopes are needed."""

_BLOCK = 32
"""States in a matrix product. BLAS computes the rows of products of other shapes by other kernels,
with other roundings: with one shape alone, a state's outputs are the same to the last bit in every
batch. More states would be wasted on small batches."""

_ZERO = np.array(0.0)
# relu and tanh, which learned conditions need at every step, work in place; maximum keeps NaN.
_ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "identity": lambda x: x,
    "tanh": lambda x: np.tanh(x, out=x),
    "relu": lambda x: np.maximum(x, _ZERO, out=x),
    "leaky_relu": lambda x: np.where(x < 0.0, 0.01 * x, x),
    "elu": lambda x: np.where(x < 0.0, np.expm1(np.minimum(x, 0.0)), x),
    "silu": lambda x: 0.5 * x * (1.0 + np.tanh(0.5 * x)),
}

# By the activated value. The sign of a rectified value is its slope, and NaN for NaN.
_SLOPES: dict[str, Callable[[np.ndarray], Any]] = {"relu": np.sign, "tanh": lambda y: 1.0 - y * y}

_VECTORS = ("input_mean", "input_scale", "output_mean", "output_scale")


@dataclass(frozen=True, eq=False)
class Network:
    """Fully connected layers between standardised inputs and outputs, in physical units outside.

    Attributes:
        weights: of each layer, (outputs, inputs) of the layer.
        biases: of each layer, (outputs,).
        activation: after every layer but the last; slopes are for those of `Activation`.
        input_mean: (p,), subtracted from the inputs.
        input_scale: (p,), by which they are divided then.
        output_mean: (q,), added to the outputs.
        output_scale: (q,), by which they are multiplied before.

    Raises:
        ConfigurationError: the shapes do not fit, a number is not finite, a scale is not positive,
            or the activation is unknown.
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    activation: str
    input_mean: np.ndarray
    input_scale: np.ndarray
    output_mean: np.ndarray
    output_scale: np.ndarray
    _folded: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("weights", "biases"):
            object.__setattr__(
                self, name, tuple(np.asarray(a, dtype=float) for a in getattr(self, name))
            )
        for name in _VECTORS:
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))
        self._check()
        with np.errstate(over="ignore", invalid="ignore"):
            object.__setattr__(self, "_folded", self._fold())
        if not all(np.isfinite(part).all() for layer in self._folded for part in layer):
            raise ConfigurationError("the numbers of a network are too large to be multiplied")

    def _check(self) -> None:
        require_activation(self.activation, _ACTIVATIONS)
        sizes = [w.shape[-1] for w in self.weights] + [len(self.output_mean)]
        fits = bool(self.weights) and [w.shape for w in self.weights] == list(
            zip(sizes[1:], sizes, strict=False)
        )
        fits = fits and [b.shape for b in self.biases] == [(size,) for size in sizes[1:]]
        ends = (sizes[0], sizes[0], sizes[-1], sizes[-1])
        if not fits or any(
            getattr(self, name).shape != (size,) for name, size in zip(_VECTORS, ends, strict=True)
        ):
            raise ConfigurationError(
                f"the layers {[w.shape for w in self.weights]} of a network do not fit each other"
                f" or the {ends[::2]} ends"
            )
        numbers = (*self.weights, *self.biases, *(getattr(self, name) for name in _VECTORS))
        if (
            not all(np.isfinite(a).all() for a in numbers)
            or (self.input_scale <= 0).any()
            or (self.output_scale <= 0).any()
        ):
            raise ConfigurationError("a network needs finite numbers, and scales above 0")

    def _fold(self) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]:
        """Return weights, their transposes and biases of each layer, standardisation included."""
        weights, biases = list(self.weights), list(self.biases)
        weights[0] = weights[0] / self.input_scale
        biases[0] = biases[0] - weights[0] @ self.input_mean
        weights[-1] = weights[-1] * self.output_scale[:, None]
        biases[-1] = biases[-1] * self.output_scale + self.output_mean
        return tuple(
            (np.ascontiguousarray(w), np.ascontiguousarray(w.T), b)
            for w, b in zip(weights, biases, strict=True)
        )

    @classmethod
    def unscaled(
        cls, weights: Sequence[np.ndarray], biases: Sequence[np.ndarray], activation: str
    ) -> Network:
        """Make a network of layers without standardisation.

        Args:
            weights: of each layer, (outputs, inputs) of the layer.
            biases: of each layer, (outputs,).
            activation: after every layer but the last.
        """
        p, q = weights[0].shape[1], len(biases[-1])
        ends = (np.zeros(p), np.ones(p), np.zeros(q), np.ones(q))
        return cls(tuple(weights), tuple(biases), activation, *ends)

    @property
    def layers(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Weights (outputs, inputs) and biases of each layer, with the standardisation in them."""
        return [(weights, bias) for weights, _, bias in self._folded]

    def outputs(self, x: np.ndarray) -> np.ndarray:
        """Return the outputs (..., q) for inputs (..., p) in one matrix product a layer."""
        return self._layers(x)[-1]

    def floats(self, inputs: Sequence[float]) -> list[float]:
        """Return the q outputs for p inputs; NaN where an input is not finite."""
        return self._layers(_one(inputs))[-1].tolist()

    def arrays(self, inputs: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        """Return the outputs at a batch.

        Args:
            inputs: p components (B,).

        Returns:
            q components (B,), NaN where an input is not finite; the same to the last bit in every
            batch that a state is in.
        """
        return _components(self._layers(_blocks(inputs))[-1], len(inputs[0]))

    def values_and_slopes_floats(
        self, inputs: Sequence[float], output: int
    ) -> tuple[list[float], list[float]]:
        """Return all outputs, and the slopes of one of them.

        Args:
            inputs: p numbers.
            output: index k of the output to differentiate.

        Returns:
            The q outputs, and the p derivatives of output k by the inputs.
        """
        layers = self._layers(_one(inputs))
        return layers[-1].tolist(), self._slopes(layers, output).tolist()

    def values_and_slopes_arrays(
        self, inputs: Sequence[np.ndarray], output: int
    ) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        """Return the same at a batch.

        Args:
            inputs: p components (B,).
            output: see `values_and_slopes_floats`.

        Returns:
            q components (B,) of the outputs, and p components (B,) of the slopes.
        """
        count, layers = len(inputs[0]), self._layers(_blocks(inputs))
        return _components(layers[-1], count), _components(self._slopes(layers, output), count)

    def _layers(self, x: np.ndarray) -> list[np.ndarray]:
        """Return what each layer gives for inputs (..., p)."""
        found, activated = [x], _ACTIVATIONS[self.activation]
        for k, (_, transposed, bias) in enumerate(self._folded, start=1):
            x = x.dot(transposed) if x.ndim == 1 else x @ transposed
            x += bias
            if k < len(self._folded):
                x = activated(x)
            found.append(x)
        return found[1:]

    def _slopes(self, layers: Sequence[np.ndarray], output: int) -> np.ndarray:
        """Return the derivatives (..., p) of an output, by backpropagation through the layers."""
        slopes = np.broadcast_to(
            self._folded[-1][0][output], (*layers[0].shape[:-1], self._folded[-1][0].shape[1])
        )
        for (weights, _, _), value in zip(self._folded[-2::-1], layers[-2::-1], strict=True):
            slopes = (slopes * _SLOPES[self.activation](value)) @ weights
        return slopes

    def to_arrays(self, prefix: str) -> dict[str, np.ndarray]:
        """Return the numbers by name, each name beginning with a prefix; for an npz file."""
        numbered = {
            f"{name}_{k}": a
            for name in ("weights", "biases")
            for k, a in enumerate(getattr(self, name))
        }
        return {
            f"{prefix}_{name}": a
            for name, a in {**numbered, **{name: getattr(self, name) for name in _VECTORS}}.items()
        }

    @classmethod
    def from_arrays(
        cls, mapping: Mapping[str, np.ndarray], prefix: str, activation: str
    ) -> Network:
        """Make a network of what `to_arrays` gave.

        Args:
            mapping: arrays by name, others among them.
            prefix: of the names.
            activation: after every layer but the last.

        Raises:
            KeyError: an array is missing.
            ConfigurationError: the arrays do not fit.
        """
        depth = sum(name.startswith(f"{prefix}_weights_") for name in mapping)
        weights, biases = (
            tuple(mapping[f"{prefix}_{name}_{k}"] for k in range(depth))
            for name in ("weights", "biases")
        )
        return cls(weights, biases, activation, *(mapping[f"{prefix}_{name}"] for name in _VECTORS))


def require_activation(name: str, allowed: Iterable[str] = get_args(Activation)) -> None:
    """Raise ConfigurationError unless an activation is one of the allowed ones.

    Args:
        name: of the activation.
        allowed: names.
    """
    if name not in allowed:
        raise ConfigurationError(f"activation = {shown(name)}; {nearest(str(name), allowed)}")


def _one(inputs: Sequence[float]) -> np.ndarray:
    """Return inputs (p,), all NaN if one is not finite: a saturated activation would hide it."""
    return (
        np.array(inputs, dtype=float)
        if all(map(math.isfinite, inputs))
        else np.full(len(inputs), math.nan)
    )


def _blocks(inputs: Sequence[np.ndarray]) -> np.ndarray:
    """Return components (B,) as blocks of states (blocks, _BLOCK, p), filled up with zeros."""
    # NaN stands for infinity.
    count = len(inputs[0])
    x = np.zeros((-(-count // _BLOCK), _BLOCK, len(inputs)))
    rows = x.reshape(-1, len(inputs))
    for i, component in enumerate(inputs):
        rows[:count, i] = component
    if not finite(x):
        x[~np.isfinite(x)] = math.nan
    return x


def _components(blocks: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    """Return the first `count` rows of blocks as contiguous components."""
    return tuple(np.ascontiguousarray(blocks.reshape(-1, blocks.shape[-1])[:count].T))


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
