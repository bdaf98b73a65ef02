"""Square, sine, cosine, arc tangent, exponential and logarithm in plain IEEE arithmetic.

The C library picks its variants by the processor (with or without fused multiply-add), so its last bit is not the same
everywhere. These are: the same operations in the same order give the same bits on every machine, here and in the
compiled kernel, whose source is made from these. Method and coefficients: fdlibm (Sun Microsystems, 1993).
"""

from __future__ import annotations

import math

from fusiond.maths.typed import compiled

HALF_PI_HIGH, HALF_PI_LOW = 1.57079632673412561417, 6.07710050650619224932e-11
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
PI_LOW = 1.2246467991473531772e-16
ROOT_HALF = 0.70710678118654752440
LOG = (
    6.666666666666735130e-01,
    3.999999999940941908e-01,
    2.857142874366239149e-01,
    2.222219843214978396e-01,
    1.818357216161805012e-01,
    1.531383769920937332e-01,
    1.479819860511658591e-01,
)
ATAN = (
    3.33333333333329318027e-01,
    -1.99999999998764832476e-01,
    1.42857142725034663711e-01,
    -1.11111104054623557880e-01,
    9.09088713343650656196e-02,
    -7.69187620504482999495e-02,
    6.66107313738753120669e-02,
    -5.83357013379057348645e-02,
    4.97687799461593236017e-02,
    -3.65315727442169155270e-02,
    1.62858201153657823623e-02,
)


@compiled
def square(x: float) -> float:
    """x * x, which is rounded once; x**2 is the C library's power."""
    return x * x


@compiled
def sin_cos(x: float) -> tuple[float, float]:
    """Sine and cosine of an angle [rad] of moderate size (below 1e5); nan where it is not finite."""
    if not math.isfinite(x):
        return math.nan, math.nan
    turns = math.floor(x / (HALF_PI_HIGH + HALF_PI_LOW) + 0.5)
    high, low = x - turns * HALF_PI_HIGH, turns * HALF_PI_LOW
    r = high - low
    tail = (high - r) - low
    z = r * r
    s = 8.33333333332248946124e-03 + z * (
        -1.98412698298579493134e-04
        + z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10))
    )
    v = z * r
    sine = r - ((z * (0.5 * tail - v * s) - tail) - v * -1.66666666666666324348e-01)
    c = z * (
        4.16666666666666019037e-02
        + z
        * (
            -1.38888888888741095749e-03
            + z
            * (
                2.48015872894767294178e-05
                + z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11))
            )
        )
    )
    half = 0.5 * z
    w = 1.0 - half
    cosine = w + (((1.0 - w) - half) + (z * c - r * tail))
    quadrant = int(turns) & 3
    if quadrant == 0:
        return sine, cosine
    if quadrant == 1:
        return cosine, -sine
    if quadrant == 2:
        return -sine, -cosine
    return -cosine, sine


@compiled
def _atan(x: float) -> float:
    """Arc tangent of x >= 0."""
    if x < 0.4375:
        high, low, u = 0.0, 0.0, x
    elif x < 0.6875:
        high, low, u = 4.63647609000806093515e-01, 2.26987774529616870924e-17, (2.0 * x - 1.0) / (2.0 + x)
    elif x < 1.1875:
        high, low, u = 7.85398163397448278999e-01, 3.06161699786838301793e-17, (x - 1.0) / (x + 1.0)
    elif x < 2.4375:
        high, low, u = 9.82793723247329054082e-01, 1.39033110312309984516e-17, (x - 1.5) / (1.0 + 1.5 * x)
    else:
        high, low, u = 1.57079632679489655800, 6.12323399573676603587e-17, -1.0 / x
    z = u * u
    w = z * z
    odd = z * (ATAN[0] + w * (ATAN[2] + w * (ATAN[4] + w * (ATAN[6] + w * (ATAN[8] + w * ATAN[10])))))
    even = w * (ATAN[1] + w * (ATAN[3] + w * (ATAN[5] + w * (ATAN[7] + w * ATAN[9]))))
    return high - ((u * (odd + even) - low) - u)


@compiled
def atan2(y: float, x: float) -> float:
    """Angle [rad] in (-pi, pi] of the point (x, y); 0 for the origin."""
    if x == 0.0 and y == 0.0:
        return 0.0
    far, near = abs(y), abs(x)
    angle = HALF_PI_HIGH + HALF_PI_LOW if near == 0.0 else _atan(far / near)
    if x < 0.0:
        angle = math.pi - (angle - PI_LOW)
    return -angle if y < 0.0 else angle


def asin(x: float) -> float:
    """Arc sine [rad]; beyond [-1, 1] as at the end."""
    return atan2(x, math.sqrt(max(0.0, (1.0 - x) * (1.0 + x))))


@compiled
def exp(x: float) -> float:
    """Exponential; 0 below -700, infinite above 700, nan of nan."""
    if math.isnan(x):
        return x
    if x < -700.0:
        return 0.0
    if x > 700.0:
        return math.inf
    k = math.floor(x / (LN2_HIGH + LN2_LOW) + 0.5)
    high, low = x - k * LN2_HIGH, k * LN2_LOW
    r = high - low
    t = r * r
    c = r - t * (
        1.66666666666666019037e-01
        + t
        * (
            -2.77777777770155933842e-03
            + t * (6.61375632143793436117e-05 + t * (-1.65339022054652515390e-06 + t * 4.13813679705723846039e-08))
        )
    )
    y = 1.0 - ((low - (r * c) / (2.0 - c)) - high)
    return math.ldexp(y, int(k))


def log(x: float) -> float:
    """Natural logarithm; minus infinity of 0, infinite of infinity, nan below 0 and of nan."""
    if not 0.0 < x < math.inf:
        return -math.inf if x == 0.0 else x if x > 0.0 else math.nan
    fraction, k = math.frexp(x)
    if fraction < ROOT_HALF:
        fraction, k = 2.0 * fraction, k - 1
    f = fraction - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    odd = z * (LOG[0] + w * (LOG[2] + w * (LOG[4] + w * LOG[6])))
    even = w * (LOG[1] + w * (LOG[3] + w * LOG[5]))
    half = 0.5 * f * f
    return k * LN2_HIGH - ((half - (s * (half + (odd + even)) + k * LN2_LOW)) - f)
