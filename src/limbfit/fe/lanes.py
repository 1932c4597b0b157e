"""Elements side by side: records whose last axis is `LANES` elements, and functions that compilers vectorise.

A loop over lanes becomes whole vectors of the machine where no lane goes a way of its own: no branches, no
calls of the C library, and places that are constant offsets in a record.  Of two records LLVM checks at run
time that they do not overlap, but only where a loop has 16 turns or more.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from ..arrays import Indices

_inlined: Any = intrinsic  # whose functions are called without their first argument, unknown to mypy
LANES = 16
_L = LANES
# Helpers are called by compiled code only; a division by zero is infinite, as in NumPy, and no branch.
COMPILED: dict[str, Any] = {
    "error_model": "numpy",
    "fastmath": {"contract"},
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}

# One quadrature point of every element.  MPa and N mm per mm^3; symmetric tensors as in `kinematics`.
POINT = np.dtype(
    [
        ("F", "f8", (3, 3, _L)),
        ("J", "f8", _L),
        ("inverse", "f8", (3, 3, _L)),  # F^-T
        ("weight", "f8", _L),  # mm^3; zero in lanes without an element
        ("scale", "f8", _L),  # s
        ("history", "f8", (6, _L)),  # K
        ("b", "f8", (6, _L)),  # F F^T; once it is diagonal, squared stretches in the first three
        ("n", "f8", (3, 3, _L)),  # columns: spatial principal directions
        ("e", "f8", (3, _L)),  # isochoric logarithmic stretches
        ("energy", "f8", _L),
        # The next three as `materials.elastic` says; then see `kernel.response`.
        ("beta", "f8", (3, _L)),
        ("slope", "f8", (6, _L)),
        ("quotient", "f8", (3, _L)),
        ("volumetric", "f8", _L),  # U
        ("pressure", "f8", _L),  # J U' or, with one pressure per element, J p
        ("stiffening", "f8", _L),  # derivative of the pressure with respect to ln J at this point
        ("tau", "f8", (6, _L)),  # Kirchhoff stress
        ("D", "f8", (6, 6, _L)),  # moduli
        ("fibre", "f8", (3, _L)),  # its direction, of length one
        ("material_fibre", "f8", (3, _L)),  # F^-1 of it
        ("fibre_tension", "f8", _L),  # T = dW/d ln(its isochoric stretch)
        ("fibre_stiffness", "f8", _L),  # dT/d ln(its isochoric stretch)
        ("fibre_tension_rates", "f8", (2, _L)),  # dT/d k1, dT/d k2
    ],
    align=True,
)
# The elastic law of every element: where its two functions are (`materials.elastic`), and what the first
# answered, kept where others answer for other lanes.
LAW = np.dtype(
    [
        ("response", "i8", _L),
        ("rates", "i8", _L),
        ("fibre", "f8", (3, _L)),  # k1, k2, active stress over the scale
        ("fibre_direction", "f8", (3, _L)),  # the fibre at rest, of length one
        ("energy", "f8", _L),
        ("beta", "f8", (3, _L)),
        ("slope", "f8", (6, _L)),
        ("quotient", "f8", (3, _L)),
    ],
    align=True,
)
NUMBER = np.dtype([("v", "f8", _L)], align=True)  # one of the numbers in each element's law
# How a point's stress changes with one of those numbers: along the principal axes, and Se.
RATE = np.dtype([("beta", "f8", (3, _L)), ("kept", "f8", (3, _L)), ("S", "f8", (6, _L))], align=True)
# A node at a point: gradient of its shape function, and the weighted traction on it.
NODE = np.dtype([("g", "f8", (3, _L)), ("traction", "f8", (3, _L))], align=True)
# A node of the element: its internal force, and the derivative of the element's volume with respect to it.
FORCE = np.dtype([("f", "f8", (3, _L)), ("volume", "f8", (3, _L))], align=True)
# What one node strains at one point gives rise to: D B; the pressure's derivative of the whole element; and
# what a point's moduli are made of: dyads of the principal axes, three normal and three of shear, moduli
# along pairs of the normal ones (as xx, yy, zz, xy, yz, zx) and of shear, and both together.
ELEMENT = np.dtype(
    [
        ("DB", "f8", (6, 3, _L)),
        ("factor", "f8", _L),
        ("axes", "f8", (6, 6, _L)),
        ("along", "f8", (9, _L)),
        ("across", "f8", (6, 6, _L)),
        ("factor_of_fibre", "f8", _L),  # and of what fibres add: its factor, their dyad and its deviator
        ("dyad", "f8", (6, _L)),
        ("deviator", "f8", (6, _L)),
    ],
    align=True,
)
BLOCK = np.dtype([("K", "f8", (9, _L))], align=True)  # stiffness between two nodes


def workspace(nodes: int, points: int, numbers: int) -> tuple[NDArray[Any], ...]:
    """Records for elements of so many nodes, points and numbers of the law.

    POINT, LAW, NUMBER, NODE, FORCE, ELEMENT, BLOCK, RATE.  NODE and RATE go point by point; the block of
    nodes a <= b is number ``b (b + 1)/2 + a``.
    """
    sizes = {POINT: points, LAW: 1, NUMBER: numbers, NODE: points * nodes, FORCE: nodes, ELEMENT: 1}
    sizes |= {BLOCK: nodes * (nodes + 1) // 2, RATE: points * numbers}
    return tuple(_allocate_aligned(kind, count) for kind, count in sizes.items())


def _allocate_aligned(kind: np.dtype[Any], count: int) -> NDArray[Any]:
    """Zeroed records that begin with a cache line, so that no vector lies across two."""
    raw = np.zeros(kind.itemsize * count + 64, dtype=np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + kind.itemsize * count].view(kind)


@lru_cache
def block_places(nodes: int) -> Indices:
    """Where the entries of the upper triangle (component-major) begin in the numbers of the BLOCKs."""
    r, c = np.triu_indices(3 * nodes)
    i, a, j, b = r // nodes, r % nodes, c // nodes, c % nodes
    entry = np.where(a <= b, 3 * i + j, 3 * j + i)
    a, b = np.minimum(a, b), np.maximum(a, b)
    return np.asarray(((b * (b + 1) // 2 + a) * 9 + entry) * LANES)


def address(function: Any, signature: Any) -> int:
    """Where the machine code of a compiled function for arguments of ``signature`` is in this process."""
    function.compile(signature)
    made = function.overloads[signature.args]
    return int(made.library.get_pointer_to_function(made.fndesc.llvm_func_name))


def _call_at_address(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    """Call the function at the first of ``values`` with the others."""
    kinds = signature.args[1:]
    pointer = context.call_conv.get_function_type(types.void, kinds).as_pointer()
    function = builder.inttoptr(values[0], pointer)
    context.call_conv.call_function(builder, function, types.void, kinds, values[1:])
    return context.get_dummy_value()


@_inlined
def call_with_two(context, where, point, numbers):  # type: ignore[no-untyped-def]
    """Call the function at an `address`; compiled code that does so need not be compiled for it."""
    return types.void(types.int64, point, numbers), _call_at_address


@_inlined
def call_with_three(context, where, point, numbers, rates):  # type: ignore[no-untyped-def]
    """`call_with_two`, with three arguments."""
    return types.void(types.int64, point, numbers, rates), _call_at_address


@_inlined
def _bits(context, x):  # type: ignore[no-untyped-def]
    """The 64 bits of a number."""

    def build(context, builder, signature, values):  # type: ignore[no-untyped-def]
        return builder.bitcast(values[0], ir.IntType(64))

    return types.int64(types.float64), build


@_inlined
def _number(context, bits):  # type: ignore[no-untyped-def]
    """The number of 64 bits."""

    def build(context, builder, signature, values):  # type: ignore[no-untyped-def]
        return builder.bitcast(values[0], ir.DoubleType())

    return types.float64(types.int64), build


@_inlined
def prefetch(context, array, index):  # type: ignore[no-untyped-def]
    """Ask for the cache line of an entry that will be changed soon."""

    def build(context, builder, signature, values):  # type: ignore[no-untyped-def]
        data = context.make_array(signature.args[0])(context, builder, values[0]).data
        line = builder.bitcast(builder.gep(data, [values[1]]), ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [line.type, *[ir.IntType(32)] * 3])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        write_keep_data = [ir.IntType(32)(value) for value in (1, 3, 1)]
        builder.call(function, [line, *write_keep_data])
        return context.get_dummy_value()

    return types.void(array, types.int64), build


_TO_INTEGER = 1.5 * 2.0**52  # added, it leaves a number's integer in its last bits
_LN2, _LN2_REST = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # the first has 33 bits
_E2, _E3, _E4, _E5, _E6, _E7, _E8, _E9, _E10, _E11, _E12, _E13 = (
    1.0 / math.factorial(n) for n in range(2, 14)
)


@njit(forceinline=True, **COMPILED)
def exponential(x):  # type: ignore[no-untyped-def]
    """``exp(x)`` within 2e-16 of its size, without branches: ``2^n`` times the series of the rest."""
    x = min(max(x, -708.0), 710.0)
    t = x * (1.0 / math.log(2.0)) + _TO_INTEGER
    n = t - _TO_INTEGER
    r = (x - n * _LN2) - n * _LN2_REST
    y = _E8 + r * (_E9 + r * (_E10 + r * (_E11 + r * (_E12 + r * _E13))))
    y = _E2 + r * (_E3 + r * (_E4 + r * (_E5 + r * (_E6 + r * (_E7 + r * y)))))
    return (1.0 + (r + r * r * y)) * _number((_bits(t) + 1023) << 52)


@njit(forceinline=True, **COMPILED)
def logarithm(x):  # type: ignore[no-untyped-def]
    """``ln(x)`` of a positive number within 2e-16 of its size, without branches.

    ``ln(1 + f) = f - f^2/2 + s (f^2/2 + 2 s^2/3 + 2 s^4/5 + ..)`` with ``s = f/(2 + f)``, and ``1 + f``
    between the roots of 1/2 and 2 (the form of FreeBSD's e_log.c).
    """
    bits = _bits(x)
    n = (bits - 0x3FE6A09E667F3BCD) >> 52  # bits of the root of 1/2
    f = _number(bits - (n << 52)) - 1.0
    s = f / (2.0 + f)
    z = s * s
    y = 1.0 / 13.0 + z * (1.0 / 15.0 + z * (1.0 / 17.0 + z * (1.0 / 19.0 + z * (1.0 / 21.0))))
    y = z * (1.0 / 3.0 + z * (1.0 / 5.0 + z * (1.0 / 7.0 + z * (1.0 / 9.0 + z * (1.0 / 11.0 + z * y)))))
    power = _number(n + _bits(_TO_INTEGER)) - _TO_INTEGER
    half = 0.5 * f * f
    return power * _LN2 - ((half - (s * (half + 2.0 * y) + power * _LN2_REST)) - f)
