"""Elementary functions with the same last bit everywhere: float64 numbers or arrays in, the same shape out.

numpy's and the C library's own take another path, and round otherwise, on each family of processors and with each
version. These use nothing but +, -, *, / and square roots, which IEEE 754 fixes, in one order, for single numbers as
for arrays. Errors stay below 3 units in the last place for what angles, ranges and weights are (angles below a million
radians, exponents within +-700). `product` stands in for `@`, which BLAS sums in an order of its own. Polynomials of
sine and cosine: fdlibm (Sun Microsystems, 1993), k_sin.c and k_cos.c; the rest are Taylor series.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

F64 = npt.NDArray[np.float64]
_BLOCK = 4096
_SIGN_SIN, _SIGN_COS = np.array([1.0, 1.0, -1.0, -1.0]), np.array([1.0, -1.0, -1.0, 1.0])
_PIO2 = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)  # pi/2 in pieces
_TWO_OVER_PI = 0.63661977236758134308
_SIN = (
    *(1.58969099521155010221e-10, -2.50507602534068634195e-08, 2.75573137070700676789e-06),
    *(-1.98412698298579493134e-04, 8.33333333332248946124e-03, -1.66666666666666324348e-01),
)
_COS = (
    *(-1.13596475577881948265e-11, 2.08757232129817482790e-09, -2.75573143513906633035e-07),
    *(2.48015872894767294178e-05, -1.38888888888741095749e-03, 4.16666666666666019037e-02),
)
_ATAN = (-1.0 / 11.0, 1.0 / 9.0, -1.0 / 7.0, 1.0 / 5.0, -1.0 / 3.0)
_ATAN_SIXTEENTHS = (  # arctan(k / 16)
    *(0.0, 0.06241880999595735, 0.12435499454676144, 0.18534794999569476, 0.24497866312686414, 0.3028848683749714),
    *(0.35877067027057225, 0.4124104415973873, 0.4636476090008061, 0.5123894603107377, 0.5585993153435624),
    *(0.6022873461349642, 0.6435011087932844, 0.6823165548747481, 0.7188299996216245, 0.7531512809621944),
    0.7853981633974483,
)
_ATAN_TABLE = np.array(_ATAN_SIXTEENTHS)
_LN2_HIGH, _LN2_LOW, _PER_LN2 = 0.6931467056274414, 4.7493250390316726e-07, 1.4426950408889634
_EXP = tuple(1.0 / math.factorial(k) for k in range(13, 1, -1))
_LOG = tuple(1.0 / k for k in range(23, 1, -2))
_SQRT_HALF = 0.7071067811865476


def sin(angle_rad: Any) -> Any:
    """Sine."""
    return sincos(angle_rad)[0]


def cos(angle_rad: Any) -> Any:
    """Cosine."""
    return sincos(angle_rad)[1]


def tan(angle_rad: Any) -> Any:
    """Tangent."""
    s, c = sincos(angle_rad)
    return s / c


def sincos(angle_rad: Any) -> tuple[Any, Any]:
    """Sine and cosine together, at little more than the price of one."""
    x = _float64(angle_rad)
    if isinstance(x, float):
        k = float(round(x * _TWO_OVER_PI))
        s, c = _kernels(((x - k * _PIO2[0]) - k * _PIO2[1]) - k * _PIO2[2])
        return ((s, c), (c, -s), (-s, -c), (-c, s))[int(k) & 3]
    out = np.empty((2, *x.shape))
    for part, angles in _blocks(out.reshape(2, -1), x):
        quarter = np.rint(angles * _TWO_OVER_PI)
        s, c = _kernels(((angles - quarter * _PIO2[0]) - quarter * _PIO2[1]) - quarter * _PIO2[2])
        turn = quarter.astype(np.int64) & 3
        odd = (turn & 1) != 0
        part[0] = np.where(odd, c, s) * _SIGN_SIN[turn]
        part[1] = np.where(odd, s, c) * _SIGN_COS[turn]
    return out[0], out[1]


def arctan2(y: Any, x: Any) -> Any:
    """Angle of (x, y) from +x, in [-pi, pi]; 0 at the origin."""
    a, b = _float64(y), _float64(x)
    if isinstance(a, float) and isinstance(b, float):
        long, short = max(abs(a), abs(b)), min(abs(a), abs(b))
        t = short / long if long > 0.0 else 0.0
        k = float(round(t * 16.0))
        angle = _ATAN_SIXTEENTHS[int(k)] + _atan_kernel(t, k)
        if abs(a) > abs(b):
            angle = math.pi / 2.0 - angle
        return math.copysign(math.pi - angle if b < 0.0 else angle, a)
    a, b = np.broadcast_arrays(a, b)
    out = np.empty(a.shape)
    for (part,), up, along in _blocks(out.reshape(1, -1), a, b):
        high, wide = np.abs(up), np.abs(along)
        longer = np.maximum(high, wide)
        share = np.minimum(high, wide) / np.where(longer > 0.0, longer, 1.0)
        step = np.rint(share * 16.0)
        angles = _ATAN_TABLE[step.astype(np.intp)] + _atan_kernel(share, step)
        angles = np.where(high > wide, math.pi / 2.0 - angles, angles)
        part[:] = np.copysign(np.where(along < 0.0, math.pi - angles, angles), up)
    return out


def arctan(x: Any) -> Any:
    """Inverse tangent."""
    return arctan2(x, 1.0)


def arcsin(x: Any) -> Any:
    """Inverse sine of a number from -1 to 1."""
    return arctan2(x, np.sqrt((1.0 - x) * (1.0 + x)))


def exp(x: Any) -> Any:
    """Exponential; 0 below -700."""
    value = np.maximum(np.asarray(x, dtype=np.float64), -700.0)
    power = np.rint(value * _PER_LN2)
    rest = (value - power * _LN2_HIGH) - power * _LN2_LOW
    out = np.ldexp(1.0 + (rest + rest * rest * _series(_EXP, rest)), power.astype(np.int32))
    out = np.where(np.less(x, -700.0), 0.0, out)
    return out if out.ndim else float(out)


def log(x: Any) -> Any:
    """Natural logarithm of a positive number."""
    part, power = np.frexp(np.asarray(x, dtype=np.float64))
    small = part < _SQRT_HALF
    part, power = np.where(small, 2.0 * part, part), np.where(small, power - 1, power).astype(np.float64)
    f = (part - 1.0) / (part + 1.0)
    ff = f * f
    out = power * _LN2_HIGH + (2.0 * (f + f * ff * _series(_LOG, ff)) + power * _LN2_LOW)
    return out if out.ndim else float(out)


def power(x: Any, exponent: float) -> Any:
    """A number from 0 raised to a positive exponent."""
    base = np.asarray(x, dtype=np.float64)
    out = np.where(base > 0.0, exp(exponent * log(np.where(base > 0.0, base, 1.0))), 0.0)
    return out if out.ndim else float(out)


def hypot(x: Any, y: Any) -> Any:
    """Length of (x, y)."""
    a, b = _float64(x), _float64(y)
    if isinstance(a, float) and isinstance(b, float):
        return math.sqrt(a * a + b * b)
    return np.sqrt(a * a + b * b)


def product(a: npt.ArrayLike, b: npt.ArrayLike) -> F64:
    """The matrix product (..., I, K) by (K, J), or by a vector (K,), summed in the order of K; for small K."""
    A, B = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    columns = B[:, None] if B.ndim == 1 else B
    out = A[..., :, 0, None] * columns[0]
    for k in range(1, len(columns)):
        out = out + A[..., :, k, None] * columns[k]
    return np.asarray(out[..., 0] if B.ndim == 1 else out)


def gaussian_filter(values: F64, sigma: float, truncate: float = 4.0) -> F64:
    """`scipy.ndimage.gaussian_filter` along every axis, whose weights come from numpy's exponential."""
    radius = int(truncate * sigma + 0.5)
    weights = exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    weights = weights / math.fsum(weights)
    out = np.asarray(values)
    for axis in range(out.ndim):
        out = ndimage.correlate1d(out, weights, axis)
    return out


def _float64(x: Any) -> Any:
    """A Python float for a single number, an array for others."""
    if isinstance(x, (float, int)):
        return float(x)
    array = np.asarray(x, dtype=np.float64)
    return array if array.ndim else float(array)


def _blocks(out: F64, *values: F64) -> Iterator[tuple[F64, ...]]:
    """Pieces of the columns of `out` and of the values, short enough to stay in the processor's cache."""
    flat = [value.reshape(-1) for value in values]
    for start in range(0, out.shape[1], _BLOCK):
        piece = slice(start, start + _BLOCK)
        yield (out[:, piece], *(value[piece] for value in flat))


def _series(terms: tuple[float, ...], x: Any) -> Any:
    """The polynomial of `terms`, highest power first, at x."""
    out = terms[0]
    for term in terms[1:]:
        out = out * x + term
    return out


def _kernels(r: Any) -> tuple[Any, Any]:
    """Sine and cosine within +-pi/4."""
    rr = r * r
    half = 0.5 * rr
    w = 1.0 - half
    return r + r * rr * _series(_SIN, rr), w + (((1.0 - w) - half) + rr * rr * _series(_COS, rr))


def _atan_kernel(t: Any, step: Any) -> Any:
    """arctan(t) - arctan(step / 16), the two less than 1/32 apart."""
    c = step * 0.0625
    z = (t - c) / (1.0 + t * c)
    zz = z * z
    return z + z * zz * _series(_ATAN, zz)
