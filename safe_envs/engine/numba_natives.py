"""The operations of kernels that differ between plain Python and compiled code: in compiled code.

See `plain_natives`. Only compiled programs import this module, which needs Numba.
"""

from __future__ import annotations

import os
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from llvmlite.binding import add_symbol, address_of_symbol
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

__all__ = [
    "c_entry",
    "decide_at",
    "entry",
    "floats_at",
    "kernel",
    "library_arc_tangent",
    "library_cosine",
    "library_sine",
    "part",
    "philox_block",
    "single",
    "table_view",
    "uniform_of",
    "vector_view",
]

# Nothing is allocated, so that arrays need not be counted, which takes longer than most kernels.
_SETTINGS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
# Python calls entry points alone; kernels compile in less time without the wrappers for it.
_UNWRAPPED: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
kernel = numba.njit(**_SETTINGS, **_UNWRAPPED, forceinline=True)
entry = numba.njit(**_SETTINGS, cache=True)
passing_entry = numba.njit(**_SETTINGS)
_FLOATS = numba.types.CPointer(numba.types.float64)
_WHOLE = numba.types.int64
_SIGNATURES = {
    "decide_columns": _WHOLE(numba.types.CPointer(_WHOLE)),
    "project_rows": _WHOLE(_WHOLE, _WHOLE, *[_FLOATS] * 6),
}
_KEPT: list[Any] = []
"""What must live as long as its address is used."""


def address_of(name: str) -> int:
    """Return the address of a function that `c_entry` has compiled."""
    return address_of_symbol(symbol_of(name))


def symbol_of(name: str) -> str:
    """Return by which name C and other programs call an entry."""
    return f"safe_envs_{name}"


def c_entry(function: Any) -> Any:
    """Compile a function that C calls, and keep it beside its file.

    Others call it without a copy of it, each of which would be compiled again with its caller.
    """
    is_kept, name = os.path.isfile(function.__code__.co_filename), function.__name__
    signature = _SIGNATURES[name]
    found = numba.cfunc(signature, cache=is_kept, error_model="numpy")(function)
    add_symbol(symbol_of(name), found.address)
    _KEPT.append(found)
    return numba.types.ExternalFunction(symbol_of(name), signature)


def part(function: Any) -> Any:
    """Compile a function that is too large for copies in each place that calls it."""
    found: Any = numba.njit(**_SETTINGS, **_UNWRAPPED)(function)
    general = found.get_call_template
    # Numba would compile it again for each number that is written in a call.
    found.get_call_template = lambda arguments, kws: general(
        tuple(map(numba.types.unliteral, arguments)), kws
    )
    return found


_WORD = np.uint64
_FIRST, _SECOND = _WORD(0xD2E7470EE14C6C93), _WORD(0xCA5A826395121157)
_FIRST_STEP, _SECOND_STEP = _WORD(0x9E3779B97F4A7C15), _WORD(0xBB67AE8584CAA73B)
_ROUNDS = 10


@intrinsic
def _high_product(_: Any, a: Any, b: Any) -> Any:
    """Return the upper half of the product of two words."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        wide = ir.IntType(128)
        product = builder.mul(*(builder.zext(word, wide) for word in arguments))
        return builder.trunc(builder.lshr(product, ir.Constant(wide, 64)), ir.IntType(64))

    return numba.types.uint64(a, b), generate


@kernel
def philox_block(c0: Any, c1: Any, c2: Any, c3: Any, k0: Any, k1: Any) -> Any:
    """Return a Philox block; see `plain_natives`."""
    c0, c1, c2, c3 = _WORD(c0), _WORD(c1), _WORD(c2), _WORD(c3)
    k0, k1 = _WORD(k0), _WORD(k1)
    for _ in range(_ROUNDS):
        first_high, first_low = _high_product(_FIRST, c0), _FIRST * c0  # pyright: ignore[reportCallIssue]
        second_high, second_low = _high_product(_SECOND, c2), _SECOND * c2
        c0, c1, c2, c3 = second_high ^ c1 ^ k0, second_low, first_high ^ c3 ^ k1, first_low
        k0 += _FIRST_STEP
        k1 += _SECOND_STEP
    return c0, c1, c2, c3


@kernel
def uniform_of(word: Any) -> Any:
    """Return a word as a number in [0, 1)."""
    return np.int64(word >> _WORD(11)) * 2.0**-53


@kernel
def single(value: Any) -> Any:
    """Return a number rounded to single precision."""
    return np.float64(np.float32(value))


def _view(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Generate an array of given first entry and shape that owns nothing."""
    # A slice takes some 5 ns, and a reshaped one 20 ns, for it clips its bounds and checks strides.
    array, first, *shape = arguments
    size = context.get_constant(numba.types.intp, 8)
    strides = [size]
    for extent in shape[:0:-1]:
        strides.insert(0, builder.mul(strides[0], extent))
    view = make_array(signature.return_type)(context, builder)
    whole = make_array(signature.args[0])(context, builder, array)
    entry_of = builder.gep(whole.data, [first])
    populate_array(view, entry_of, shape, strides, size, meminfo=None)
    return view._getvalue()


@intrinsic
def floats_at(_: Any, address: Any) -> Any:
    """See `plain_natives`."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], ir.DoubleType().as_pointer())

    return numba.types.CPointer(numba.types.float64)(address), generate


_NUMBERS_OF_DECISION = 26
_IN_DATA = (3, 4, 7)


@intrinsic
def decide_at(_: Any, data: Any, work: Any, place: Any) -> Any:
    """See `safe_envs.engine.decide`."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        whole = ir.IntType(64)
        data, work = (
            make_array(kind)(context, builder, argument).data
            for kind, argument in zip(signature.args, arguments[:2], strict=False)
        )
        numbers = cgutils.alloca_once(builder, whole, _NUMBERS_OF_DECISION)
        for i in range(_NUMBERS_OF_DECISION):
            at = builder.add(arguments[2], ir.Constant(whole, i))
            number = builder.fptosi(builder.load(builder.gep(data, [at])), whole)
            if i > 2:
                base = data if i in _IN_DATA else work
                number = builder.ptrtoint(builder.gep(base, [number]), whole)
            builder.store(number, builder.gep(numbers, [ir.Constant(whole, i)]))
        kind = ir.FunctionType(whole, [whole.as_pointer()])
        name = symbol_of("decide_columns")
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, [numbers])

    number = numba.types.int64
    return number(data, work, number), generate


@intrinsic
def vector_view(_: Any, array: Any, first: Any, count: Any) -> Any:
    """See `plain_natives`."""
    place = numba.types.intp
    return numba.types.Array(array.dtype, 1, "C")(array, place, place), _view


@intrinsic
def table_view(_: Any, array: Any, first: Any, rows: Any, columns: Any) -> Any:
    """See `plain_natives`."""
    place = numba.types.intp
    return numba.types.Array(array.dtype, 2, "C")(array, place, place, place), _view


def _rare(name: str) -> Any:
    """Return a function of the C library for branches that are seldom taken."""
    # The compiler would call the sine that it knows in any case, wanted or not, and keep numbers in
    # memory for the calls.

    def generate(_: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = ir.DoubleType()
        kind = ir.FunctionType(number, [number] * len(signature.args))
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        for attribute in ("cold", "nounwind", "readnone"):
            function.attributes.add(attribute)
        return builder.call(function, arguments)

    return generate


@intrinsic
def library_sine(_: Any, x: Any) -> Any:
    """See `plain_natives`."""
    return numba.types.float64(x), _rare("sin")


@intrinsic
def library_cosine(_: Any, x: Any) -> Any:
    """See `plain_natives`."""
    return numba.types.float64(x), _rare("cos")


@intrinsic
def library_arc_tangent(_: Any, y: Any, x: Any) -> Any:
    """See `plain_natives`."""
    return numba.types.float64(y, x), _rare("atan2")
