"""LLVM instructions for compiled kernels: 64 pixels compared or 16 copied at a time, and arrays at an address.

The only module with LLVM IR. Its gain, the time without it over the time with it, was measured side by side with
plain loops in its place on one core of a shared machine. Images to tracks of 4 x 656 x 491 pixels and 200 markers /
detection in 15.5 megapixels gained by ``bright_mask`` with the two bit counts 1.26 / 4.0, and by ``copy_16`` 1.07 /
1.0, where runs of the same code differ by 0.04. Detection alone of the four images took 1.10 to 1.15 times as long
without ``copy_16`` (1.36 to 1.41 ms against 1.22 to 1.23 ms, three pairs in turn).
"""

from typing import Any

from numba.core import cgutils, types
from numba.core.cgutils import ir  # type: ignore[attr-defined]
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array


def _instruction(code: Any) -> Any:
    """Make an intrinsic, untyped for its callers: Numba itself passes the typing context."""
    return intrinsic(code)


@_instruction
def bright_mask(_context: Any, address: Any, like: Any, limits: Any) -> Any:
    """Return which of the 64 pixels from ``address`` (uint64) on exceed those from ``limits`` (uint64) on.

    The result is an int64 whose bit k is for pixel k.

    Pixels are of the type of the array ``like``, unsigned. It is one comparison of 64 lanes, which the compiler
    divides into those of the machine.
    """

    def code(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        pixel = ir.IntType(like.dtype.bitwidth)
        lanes = ir.VectorType(pixel, 64)
        pixels, limits = (
            builder.load(builder.inttoptr(arguments[k], lanes.as_pointer()), align=pixel.width // 8) for k in (0, 2)
        )
        return builder.bitcast(builder.icmp_unsigned(">", pixels, limits), ir.IntType(64))

    return types.int64(types.uint64, like, types.uint64), code


@_instruction
def trailing_zeros(_context: Any, mask: Any) -> Any:
    """Return the number of the lowest bit set in an int64, 64 where none is."""

    def code(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.IntType(1)(0))

    return types.int64(types.int64), code


@_instruction
def bits_set(_context: Any, mask: Any) -> Any:
    """Return how many bits of an int64 are set."""

    def code(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.int64), code


@_instruction
def copy_16(_context: Any, source: Any, like: Any, target: Any, wanted: Any) -> Any:
    """Copy the 16 values from ``source`` (uint64) on, of the type of the array ``like``, unsigned, to ``target``.

    At ``target`` they are of the type of the array ``wanted``, a float32 or a wider integer. All are copied at once.
    """

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pixel, number = ir.IntType(like.dtype.bitwidth), context.get_value_type(wanted.dtype)
        given, made = ir.VectorType(pixel, 16), ir.VectorType(number, 16)
        pixels = builder.load(builder.inttoptr(arguments[0], given.as_pointer()), align=pixel.width // 8)
        is_whole = isinstance(wanted.dtype, types.Integer)
        values = builder.zext(pixels, made) if is_whole else builder.uitofp(pixels, made)
        builder.store(values, builder.inttoptr(arguments[2], made.as_pointer()), align=wanted.dtype.bitwidth // 8)
        return context.get_constant_null(signature.return_type)

    return types.void(types.uint64, like, types.uint64, wanted), code


@_instruction
def array_at(_context: Any, address: Any, like: Any, shape: Any) -> Any:
    """Return the contiguous array of a shape and of the type of ``like`` at ``address`` (uint64), without owning it.

    So compiled code can use images given by their addresses, and parts of working memory, without a reference count.
    The caller must keep the owner alive. (Numba's ``carray`` does the same for pointers; what is compiled without
    reference counting must not call it.)
    """

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        made = context.make_array(signature.return_type)(context, builder)
        data = builder.inttoptr(arguments[0], made.data.type)
        size = context.get_constant(types.intp, like.dtype.bitwidth // 8)
        extents = [
            context.cast(builder, extent, kind, types.intp)
            for kind, extent in zip(shape, cgutils.unpack_tuple(builder, arguments[2]), strict=True)
        ]
        strides = [size]
        for extent in extents[:0:-1]:
            strides.insert(0, builder.mul(strides[0], extent))
        populate_array(made, data, extents, strides, size, None)
        return made._getvalue()

    return types.Array(like.dtype, len(shape), "C")(types.uint64, like, shape), code
