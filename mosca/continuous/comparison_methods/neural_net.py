"""Networks of one hidden layer as functions of time, many at once, and least squares over their weights.

y(t) = V tanh(U e(t) + b) + c with the positional encoding e(t) = (sin pi s, cos pi s, sin 2 pi s, cos 2 pi s), s from
0 to 1 over the recording (Mildenhall et al. 2020 with two frequencies: the four numbers of the second paper; no two
instants share a code). There are far more weights than image points, so Gauss-Newton steps are solved in the space of
the observations. Of all steps dw with J dw = r (J (q, w) by the weights), the shortest is J' (J J')^-1 r. J J', the
tangent kernel (Jacot et al. 2018), is a sum of two element-wise products.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from mosca.data.arrays import Array

HIDDEN = 256
FREQUENCIES = (1.0, 2.0)
"""Half periods of the encoding over the whole recording."""
RIDGE = 1e-6
"""Damping of a fit, relative to the kernel's mean diagonal: how firmly it keeps the weights."""


@dataclass(frozen=True, eq=False)
class Nets:
    """p networks with o outputs each: ``inner`` (p, h, 4), ``bias`` (p, h), ``outer`` (p, o, h), ``shift`` (p, o).

    ``start_s`` and ``duration_s`` set the encoding.
    """

    inner: Array
    bias: Array
    outer: Array
    shift: Array
    start_s: float
    duration_s: float

    @classmethod
    def fresh(
        cls, count: int, outputs: int, span_s: tuple[float, float], response_s: float, rng: np.random.Generator
    ) -> "Nets":
        """Return networks with output zero whose hidden units switch within ``response_s`` at random instants."""
        start, duration = span_s[0], max(span_s[1] - span_s[0], 1e-9)
        speed = np.pi * np.sqrt(np.square(FREQUENCIES).sum())  # of the encoding, by s
        inner = rng.normal(0, duration / (speed * response_s), (HIDDEN, 4))
        where = encoded(rng.uniform(0, 1, HIDDEN))
        bias = -(inner * where).sum(axis=1)
        return cls(
            np.tile(inner, (count, 1, 1)), np.tile(bias, (count, 1)), np.zeros((count, outputs, HIDDEN)),
            np.zeros((count, outputs)), start, duration
        )  # fmt: skip

    def code(self, time_s: Array) -> Array:
        """Return the encoding (t, 4) of instants."""
        return encoded((np.asarray(time_s) - self.start_s) / self.duration_s)

    def hidden(self, time_s: Array) -> Array:
        """Return the hidden units' values (p, t, h)."""
        return np.asarray(np.tanh(self.code(time_s) @ np.swapaxes(self.inner, 1, 2) + self.bias[:, None]))

    def at(self, time_s: Array) -> Array:
        """Return the outputs (p, t, o)."""
        return np.asarray(self.hidden(time_s) @ np.swapaxes(self.outer, 1, 2) + self.shift[:, None])


def encoded(s: Array) -> Array:
    """Return the positional encoding (n, 4) of s (n,), 0 to 1."""
    turns = np.pi * np.asarray(s)[:, None] * np.array(FREQUENCIES)
    return np.stack([np.sin(turns), np.cos(turns)], axis=2).reshape(len(turns), -1)


@dataclass(frozen=True, eq=False)
class Tangent:
    """The networks' derivatives at q instants of each network, ``code`` (p, q, 4), multiplied by linear maps ``onto``
    (p, q, i, o) of the outputs: q observations of i numbers each.
    """

    nets: Nets
    code: Array
    onto: Array
    hidden: Array
    through: Array

    @classmethod
    def of(cls, nets: Nets, time_s: Array, onto: Array) -> "Tangent":
        """Return the derivatives at ``time_s`` (p, q)."""
        p, q = time_s.shape
        code = nets.code(time_s.ravel()).reshape(p, q, 4)
        hidden = np.tanh(code @ np.swapaxes(nets.inner, 1, 2) + nets.bias[:, None])
        through = (onto.reshape(p, -1, onto.shape[-1]) @ nets.outer).reshape(*onto.shape[:3], -1)
        return cls(nets, code, onto, hidden, through * (1 - hidden**2)[:, :, None])

    def kernel(self) -> Array:
        """Return J J' (p, q i, q i) of all weights of each network."""
        p, q, i, _ = self.onto.shape
        flat = self.onto.reshape(p, q * i, -1)
        inner = self.through.reshape(p, q * i, -1)
        of_outer = self.hidden @ np.swapaxes(self.hidden, 1, 2) + 1
        of_inner = self.code @ np.swapaxes(self.code, 1, 2) + 1
        whole = inner @ np.swapaxes(inner, 1, 2)
        whole = whole.reshape(p, q, i, q, i) * of_inner[:, :, None, :, None]
        direct = (flat @ np.swapaxes(flat, 1, 2)).reshape(p, q, i, q, i) * of_outer[:, :, None, :, None]
        return np.asarray((whole + direct).reshape(p, q * i, q * i))

    def moved(self, dual: Array) -> Nets:
        """Return the networks with weights changed by J' dual, ``dual`` (p, q i)."""
        p, q, i, _ = self.onto.shape
        weight = dual.reshape(p, q, i)
        by_output = np.einsum("pqi,pqio->pqo", weight, self.onto)
        by_unit = np.einsum("pqi,pqih->pqh", weight, self.through)
        return replace(
            self.nets,
            inner=self.nets.inner + np.swapaxes(by_unit, 1, 2) @ self.code,
            bias=self.nets.bias + by_unit.sum(axis=1),
            outer=self.nets.outer + np.swapaxes(by_output, 1, 2) @ self.hidden,
            shift=self.nets.shift + by_output.sum(axis=1),
        )


def damped_solve(kernel: Array, damping: Array, right: Array) -> Array:
    """Return (K + d I)^-1 right for kernels (p, n, n), damping (p,), right sides (p, n, m); overwrites ``kernel``."""
    solved = np.empty_like(right)
    for k, matrix in enumerate(kernel):
        matrix.flat[:: len(matrix) + 1] += damping[k]
        factor = cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
        solved[k] = cho_solve(factor, right[k], check_finite=False)
    return solved


def fitted(nets: Nets, time_s: Array, values: Array, *, steps: int = 8) -> Nets:
    """Return the networks fitted to ``values`` (p, t, o) at instants (t,) by damped Gauss-Newton steps."""
    p, t, o = values.shape
    known = np.asarray(np.isfinite(values).all(axis=2))
    onto = np.where(known[:, :, None, None], np.eye(o), 0.0)
    times = np.tile(time_s, (p, 1))
    cost = np.inf
    for _ in range(steps):
        rest = np.where(known[..., None], values - nets.at(time_s), 0.0)
        now = float((rest**2).sum())
        if now >= 0.98 * cost:
            break
        cost = now
        tangent = Tangent.of(nets, times, onto)
        kernel = tangent.kernel()
        damping = RIDGE * np.einsum("paa->p", kernel) / max(t * o, 1) + 1e-300
        dual = damped_solve(kernel, damping, rest.reshape(p, -1, 1))[..., 0]
        trial = tangent.moved(dual)
        after = np.where(known[..., None], values - trial.at(time_s), 0.0)
        if float((after**2).sum()) >= cost:
            break
        nets = trial
    return nets
