"""Counter-based random numbers for pixels: each pixel's numbers depend on its own state alone.

A stream is a 64-bit state. Each number is ``mix(state)`` after ``state += STEP`` (SplitMix64: Steele, Lea and Flood,
OOPSLA 2014), and a pixel's stream begins at a state computed from (key, pixel number). The integers are the same on
all platforms. The real numbers are computed from them by plain IEEE arithmetic, except where a logarithm or an
exponential of the platform's library is used (stated at each function): there the last bit may differ.
"""

import math
from typing import Any

import numpy as np

from mosca.numba_support.decorators import kernel, step

STEP = np.uint64(0x9E3779B97F4A7C15)
"""The odd number nearest to 2^64 over the golden ratio: successive states never repeat within 2^64."""


@kernel
def mix(x: Any) -> Any:
    """SplitMix64's finaliser: 64 well mixed bits of a counter (uint64)."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@kernel
def uniform(bits: Any) -> Any:
    """A number in (0, 1) from 52 of 64 random bits; it and its complement are exact."""
    return (np.float64(bits >> np.uint64(12)) + 0.5) / 4503599627370496.0


@kernel
def normal(bits: Any) -> Any:
    """A standard normal number from 64 random bits: the inverse distribution function, to about 1 part in 10^16.

    Wichura, Algorithm AS 241 (PPND16), Applied Statistics 37 (1988) 477. Plain arithmetic within 1.44 sigma
    (85 %); beyond, a logarithm and a square root.
    """
    p = uniform(bits)
    q = p - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        return q * (
            (((((((2.5090809287301226727e3 * r + 3.3430575583588128105e4) * r + 6.7265770927008700853e4) * r
            + 4.5921953931549871457e4) * r + 1.3731693765509461125e4) * r + 1.9715909503065514427e3) * r
            + 1.3314166789178437745e2) * r + 3.3871328727963666080e0)
            / (((((((5.2264952788528545610e3 * r + 2.8729085735721942674e4) * r + 3.9307895800092710610e4) * r
            + 2.1213794301586595867e4) * r + 5.3941960214247511077e3) * r + 6.8718700749205790830e2) * r
            + 4.2313330701600911252e1) * r + 1.0)
        )  # fmt: skip
    r = math.sqrt(-math.log(min(p, 1.0 - p)))
    if r <= 5.0:
        r -= 1.6
        x = (
            (((((((7.74545014278341407640e-4 * r + 2.27238449892691845833e-2) * r + 2.41780725177450611770e-1) * r
            + 1.27045825245236838258e0) * r + 3.64784832476320460504e0) * r + 5.76949722146069140550e0) * r
            + 4.63033784615654529590e0) * r + 1.42343711074968357734e0)
            / (((((((1.05075007164441684324e-9 * r + 5.47593808499534494600e-4) * r + 1.51986665636164571966e-2) * r
            + 1.48103976427480074590e-1) * r + 6.89767334985100004550e-1) * r + 1.67638483018380384940e0) * r
            + 2.05319162663775882187e0) * r + 1.0)
        )  # fmt: skip
    else:
        r -= 5.0
        x = (
            (((((((2.01033439929228813265e-7 * r + 2.71155556874348757815e-5) * r + 1.24266094738807843860e-3) * r
            + 2.65321895265761230930e-2) * r + 2.96560571828504891230e-1) * r + 1.78482653991729133580e0) * r
            + 5.46378491116411436990e0) * r + 6.65790464350110377720e0)
            / (((((((2.04426310338993978564e-15 * r + 1.42151175831644588870e-7) * r + 1.84631831751005468180e-5) * r
            + 7.86869131145613259100e-4) * r + 1.48753612908506148525e-2) * r + 1.36929880922735805310e-1) * r
            + 5.99832206555887937690e-1) * r + 1.0)
        )  # fmt: skip
    return -x if q < 0.0 else x


@kernel
def poisson(mu: float, bits: Any) -> Any:
    """A Poisson number of mean mu >= 0 from 64 random bits, as a float: exact inversion, so that it grows with mu.

    For mu >= 10 the asymptotic series of the inverse distribution function is used (Giles, Algorithm 955, ACM Trans.
    Math. Softw. 42 (2016) 7). Its integer part is the number, unless an integer lies within the error of the series
    (once in some 10^4); then the probabilities themselves decide. Below 10 the probabilities are summed from 0.
    """
    p = uniform(bits)
    if mu < 10.0:
        n, share = 0.0, math.exp(-mu)
        while p > share and share > 0.0:
            p -= share
            n += 1.0
            share *= mu / n
        return n
    w, root = normal(bits), math.sqrt(mu)
    w2, fall = w * w, 1.0 / root
    x = mu + root * w + (2.0 + w2) * (1.0 / 6.0)
    x += fall * ((w2 * (w2 + 7.0 / 3.0) * (1.0 / 270.0) - 8.0 / 405.0) * fall - (2.0 + w2) * w * (1.0 / 72.0))
    error = (0.03 + 0.002 * w2 * w2 * w2) * fall * fall * fall + 1e-13 * mu
    n = np.floor(x)
    if error < x - n < 1.0 - error:
        return n
    return _search(max(n, 0.0), mu, p)


@step
def _search(n: float, mu: float, p: float) -> float:
    """The largest n with P(N < n) <= p, by a search that starts at the guess ``n``."""
    while not _reached(n, mu, p):
        n -= 1.0
    while _reached(n + 1.0, mu, p):
        n += 1.0
    return n


@step
def _reached(n: float, mu: float, p: float) -> bool:
    """Whether P(N < n) <= p: the smaller of the two tails is summed until its terms are negligible."""
    if n <= 0.0:
        return True
    share = math.exp(n * math.log(mu) - mu - math.lgamma(n + 1.0))
    total = 0.0
    if n <= mu:
        while n > 0.0 and share > 1e-17 * total:
            share *= n / mu
            n -= 1.0
            total += share
        return total <= p
    while share > 1e-17 * total:
        total += share
        n += 1.0
        share *= mu / n
    return 1.0 - p <= total
