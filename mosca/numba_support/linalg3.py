"""Linear algebra of three dimensions for compiled code: symmetric 3 x 3 matrices and vectors as scalars.

Matrices are NamedTuples of numbers, which Numba keeps in registers: no array is made and none is counted, so that
bare steps may make and return them. All functions are inlined: as calls they cost matching 8 %. Inverses are by
cofactors: good to about the condition number times 1e-16, far better than covariances of single points need.
"""

from typing import Any, NamedTuple

from mosca.numba_support.decorators import inlined_step


class Symmetric3(NamedTuple):
    """A symmetric 3 x 3 matrix by its upper triangle."""

    xx: float
    xy: float
    xz: float
    yy: float
    yz: float
    zz: float


@inlined_step
def symmetric3(matrix: Any) -> Symmetric3:
    """Return the upper triangle of an array (3, 3)."""
    return Symmetric3(matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[1, 1], matrix[1, 2], matrix[2, 2])


@inlined_step
def store3(a: Symmetric3, out: Any) -> None:
    """Write a matrix into an array (3, 3)."""
    out[0, 0], out[1, 1], out[2, 2] = a.xx, a.yy, a.zz
    out[0, 1] = out[1, 0] = a.xy
    out[0, 2] = out[2, 0] = a.xz
    out[1, 2] = out[2, 1] = a.yz


@inlined_step
def sum3(a: Symmetric3, b: Symmetric3) -> Symmetric3:
    """Return a + b."""
    return Symmetric3(a.xx + b.xx, a.xy + b.xy, a.xz + b.xz, a.yy + b.yy, a.yz + b.yz, a.zz + b.zz)


@inlined_step
def plus_identity3(a: Symmetric3, factor: float) -> Symmetric3:
    """Return a + factor I."""
    return Symmetric3(a.xx + factor, a.xy, a.xz, a.yy + factor, a.yz, a.zz + factor)


@inlined_step
def scaled3(a: Symmetric3, factor: float) -> Symmetric3:
    """Return factor a."""
    return Symmetric3(a.xx * factor, a.xy * factor, a.xz * factor, a.yy * factor, a.yz * factor, a.zz * factor)


@inlined_step
def divided3(a: Symmetric3, divisor: float) -> Symmetric3:
    """Return a / divisor, each element by a division of its own."""
    return Symmetric3(a.xx / divisor, a.xy / divisor, a.xz / divisor, a.yy / divisor, a.yz / divisor, a.zz / divisor)


@inlined_step
def cofactors3(a: Symmetric3) -> Symmetric3:
    """Return the cofactors: the inverse times the determinant."""
    return Symmetric3(
        a.yy * a.zz - a.yz * a.yz,
        a.xz * a.yz - a.xy * a.zz,
        a.xy * a.yz - a.xz * a.yy,
        a.xx * a.zz - a.xz * a.xz,
        a.xy * a.xz - a.xx * a.yz,
        a.xx * a.yy - a.xy * a.xy,
    )


@inlined_step
def determinant3(a: Symmetric3, cofactors: Symmetric3) -> float:
    """Return the determinant by the first row; ``cofactors`` are those of ``a``."""
    return a.xx * cofactors.xx + a.xy * cofactors.xy + a.xz * cofactors.xz


@inlined_step
def inverse3(a: Symmetric3) -> Symmetric3:
    """Return the inverse; infinities or NaN for a singular matrix."""
    cofactors = cofactors3(a)
    result: Symmetric3 = divided3(cofactors, determinant3(a, cofactors))
    return result


@inlined_step
def times3(a: Symmetric3, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a (x, y, z)'."""
    return a.xx * x + a.xy * y + a.xz * z, a.xy * x + a.yy * y + a.yz * z, a.xz * x + a.yz * y + a.zz * z


@inlined_step
def quadratic_form3(a: Symmetric3, x: float, y: float, z: float) -> float:
    """Return (x, y, z) a (x, y, z)'."""
    return a.xx * x * x + a.yy * y * y + a.zz * z * z + 2.0 * (a.xy * x * y + a.xz * x * z + a.yz * y * z)


@inlined_step
def mahalanobis3(covariance: Symmetric3, x: float, y: float, z: float) -> tuple[float, float]:
    """Return the squared Mahalanobis distance of an innovation (x, y, z) and its covariance's determinant."""
    cofactors = cofactors3(covariance)
    determinant = determinant3(covariance, cofactors)
    return quadratic_form3(cofactors, x, y, z) / determinant, determinant
