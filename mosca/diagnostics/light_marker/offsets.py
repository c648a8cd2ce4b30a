"""Cameras without a trigger, synchronised by a light that flashes in all their views.

A lamp that goes on or off at irregular times is seen by every camera. Where the edge falls into an exposure, the
image of the lamp is lit in part, and the part gives the instant:

    on:   t = start of exposure + (1 - part) * exposure        off:   t = start of exposure + part * exposure

Where the edge falls between two exposures, it may lie anywhere in this dark gap: its distribution is uniform, with
the gap's length over the square root of 12 as standard deviation. So cameras whose exposure fills most of the period
measure edges to microseconds. Cameras with short exposures need many edges, each at another phase.

The frames' own time stamps are compared. The result is by how much a camera's stamps are ahead of the reference
camera's for the same instant, and how fast this offset grows. It applies to any clocks. For one common clock the
offset is the error of the synchronisation.
"""

import math
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.frames import FrameSource
from mosca.diagnostics.light_marker.brightness import Brightness, light_of_lamp
from mosca.errors import InputError

LEAST_DN = 20.0
"""Least change of the brightest pixel by a lamp, in images of 8 bits."""
HALF = 0.5
"""Share of a lamp's light from which it counts as lit: an edge lies between two frames on either side of it."""
FEWEST_EDGES, EDGES_FOR_DRIFT = 2, 4
SURE_SIGMAS = 4.0
"""Standard deviations of the light beyond which a frame is partly lit, and of the times of two edges within which
they are one edge: 6 in 100,000 normal errors are larger."""
LARGEST_NOISE = 0.08
"""Largest scatter of a lamp that is lit, or dark, over its light; what scatters more is no lamp."""
AGREE_S = 2e-4
"""Additional time [s] within which two edges are one: less loses edges whose stated errors are too small, more
confuses the flashes of a fast lamp."""
AS_GOOD = 0.7
"""Share of the best shift's edges: another shift that matches more might be the true one."""
LARGEST_DRIFT = 5e-4
"""Largest relative drift of two clocks: two crystals of 100 ppm and a margin for one warm camera."""


@dataclass(frozen=True)
class Edges:
    """Times at which a camera saw the lamp change, in the camera's own stamps."""

    origin_ns: int
    """Origin of the times [ns]."""
    time_s: Array
    """(n,) since the origin [s]."""
    sigma_s: Array
    """(n,) standard deviation [s]."""
    on: Array
    """(n,) whether the lamp went on."""
    partly: int
    """Number of edges measured from a partly lit frame."""


@dataclass(frozen=True)
class FlashOffset:
    """A camera's stamps against the reference's."""

    camera: str
    offset_s: float
    """How far ahead its stamps are at the middle of the edges [s]."""
    offset_sigma_s: float
    drift_ppm: float
    """How much faster its clock runs."""
    drift_sigma_ppm: float | None
    """None with too few edges."""
    edges: int
    """Edges seen by both."""
    rest_s: float
    """RMS of the residuals [s]."""
    as_stated: float
    """Ratio of the residuals to the edges' own standard deviations (1 where they agree)."""


@dataclass(frozen=True)
class FlashSync:
    """Result: the ``reference``, which is the first camera, and the offsets of the others."""

    reference: str
    offsets: tuple[FlashOffset, ...]
    notes: tuple[str, ...] = ()
    """What could not be found."""

    def lines(self) -> list[str]:
        """Return it in words, a line a camera."""
        lines = []
        for one in self.offsets:
            drift = (
                "too few edges for a drift"
                if one.drift_sigma_ppm is None
                else f"drift {one.drift_ppm:+.1f} +- {one.drift_sigma_ppm:.1f} ppm"
            )
            lines.append(
                f"camera '{one.camera}': stamps {1e3 * one.offset_s:+.4f} +- {1e3 * one.offset_sigma_s:.4f} ms "
                f"ahead of '{self.reference}', {drift}, {one.edges} edges of the flash"
            )
        return [*lines, *self.notes]


def synchronise(source: FrameSource) -> FlashSync:
    """Return the offsets of a recording's cameras' time stamps to each other, from flashes that all of them filmed.

    ``source`` is read twice. Cameras and lamp are still, or the lamp is moved before a dark background.
    Raises InputError where a camera saw no flash, or where flashes come too evenly to be identified.
    """
    edges = {name: edges_of(name, seen) for name, seen in light_of_lamp(source).items()}
    if len(edges) < 2:
        raise InputError("flash: one camera has nobody to be synchronised with")
    reference = next(iter(edges))
    offsets = tuple(align(name, edges[reference], found) for name, found in edges.items() if name != reference)
    notes = tuple(
        f"camera '{name}': no edge fell into an exposure; each is known to the gap between two, "
        f"{2e3 * math.sqrt(3) * float(np.median(found.sigma_s)):.3g} ms: make the exposure longer"
        for name, found in edges.items()
        if not found.partly
    )
    return FlashSync(reference, offsets, notes)


def edges_of(name: str, seen: Brightness) -> Edges:
    """Return the edges in a camera's brightness; InputError naming the camera where there are none."""
    if seen.most_dn < LEAST_DN / 255 * seen.full_dn:
        raise InputError(
            f"camera '{name}': no flash seen, the brightest change is {seen.most_dn:.0f} of {seen.full_dn:.0f} DN; "
            "flash a lamp in the view of all cameras, longer than two frames"
        )
    middle = (seen.light.min() + seen.light.max()) / 2
    dark, lit = (
        float(np.median(part)) for part in (seen.light[seen.light < middle], seen.light[seen.light >= middle])
    )
    part = (seen.light - dark) / (lit - dark)
    noise = max(_spread(part[part < HALF / 2]), _spread(part[part > 1 - HALF / 2]), 1e-4)
    if noise > LARGEST_NOISE:
        raise InputError(
            f"camera '{name}': what changes in its view does so gradually, as things that move do, not as a lamp "
            "that flashes; flash one in the view of all cameras, with nothing moving"
        )
    steps = [k for k in range(1, len(part)) if (part[k - 1] < HALF) != (part[k] < HALF)]
    times, sigmas, ons, partly = [], [], [], 0
    for k in steps:
        on = bool(part[k] >= HALF)
        edge = _edge(seen, part, k, on, noise)
        if edge is None:
            continue
        time_ns, sigma_ns, in_part = edge
        times.append(time_ns)
        sigmas.append(sigma_ns)
        ons.append(on)
        partly += in_part
    if len(times) < FEWEST_EDGES:
        raise InputError(
            f"camera '{name}': {len(times)} edges of a flash seen, {FEWEST_EDGES} at least are wanted; flash the "
            "lamp several times, on and off for longer than two frames"
        )
    origin = int(seen.start_ns[0])
    return Edges(
        origin,
        np.array([t - origin for t in times], dtype=np.float64) * 1e-9,
        np.array(sigmas) * 1e-9,
        np.array(ons),
        partly,
    )


def align(name: str, reference: Edges, own: Edges) -> FlashOffset:
    """Return offset and drift of ``own`` stamps against those of ``reference``; InputError where none is certain."""
    pairs, shift = _matched(name, reference, own)
    a, b = pairs[:, 0], pairs[:, 1]
    t = reference.time_s[a]
    sigma = np.hypot(reference.sigma_s[a], own.sigma_s[b])
    # the whole seconds between two clocks are subtracted as integers: doubles keep nanoseconds of the rest
    ahead = own.time_s[b] - t - shift
    middle = float(np.average(t, weights=sigma**-2))
    with_drift = len(t) >= EDGES_FOR_DRIFT
    design = np.column_stack((np.ones_like(t), t - middle)[: 2 if with_drift else 1])
    weighted = design / sigma[:, None]
    covariance = np.linalg.inv(weighted.T @ weighted)
    found = covariance @ weighted.T @ (ahead / sigma)
    rest = ahead - design @ found
    freedom = max(len(t) - design.shape[1], 1)
    as_stated = max(1.0, math.sqrt(float(np.sum((rest / sigma) ** 2)) / freedom))
    deviations = np.sqrt(np.diag(covariance)) * as_stated
    origins_s = (own.origin_ns - reference.origin_ns) * 1e-9
    return FlashOffset(
        name,
        float(found[0]) + shift + origins_s,
        float(deviations[0]),
        float(found[1]) * 1e6 if with_drift else 0.0,
        float(deviations[1]) * 1e6 if with_drift else None,
        len(t),
        float(np.sqrt(np.mean(rest**2))),
        as_stated,
    )


def _edge(seen: Brightness, part: Array, k: int, on: bool, noise: float) -> tuple[float, float, bool] | None:
    """Return time and standard deviation [ns] of the edge about frame ``k``, and whether it was seen in part."""
    # the partly lit frame of the two, if there is one
    partial = [j for j in (k - 1, k) if SURE_SIGMAS * noise < part[j] < 1 - SURE_SIGMAS * noise]
    if len(partial) > 1:
        return None  # a single edge does not light two frames partly: the lamp itself is slow, or flickers
    if partial and not seen.clipped:
        j, share = partial[0], float(part[partial[0]])
        exposure = float(seen.exposure_ns[j])
        time = float(seen.start_ns[j]) + exposure * ((1 - share) if on else share)
        return time, max(exposure * noise, 1.0), True
    begin, end = _bounds(seen, partial, k, on)
    # a frame that seems fully lit or dark may hide a part within its noise: this belongs to the gap
    slack = SURE_SIGMAS * noise * float(seen.exposure_ns[k])
    return (begin + end) / 2, (max(end - begin, 0.0) + 2 * slack) / math.sqrt(12), False


def _bounds(seen: Brightness, partial: list[int], k: int, on: bool) -> tuple[float, float]:
    """Return the instants [ns] between which the edge about frame ``k`` lies, where no partly lit frame gives it."""
    ends = seen.start_ns + seen.exposure_ns
    if partial:
        return float(seen.start_ns[partial[0]]), float(ends[partial[0]])
    if not seen.clipped:
        return float(ends[k - 1]), float(seen.start_ns[k])
    # a part of the light already saturates the pixels: a lit frame may be lit from any instant of its exposure
    if on:
        return float(ends[k - 1]), float(ends[k])
    return float(seen.start_ns[k - 1]), float(seen.start_ns[k])


def _matched(name: str, reference: Edges, own: Edges) -> tuple[Array, float]:
    """Return pairs (n, 2) of edges and the shift [s] that brings them together, the one that matches most edges."""
    best: list[tuple[int, float, Array]] = []
    for i in range(len(reference.time_s)):
        for j in range(len(own.time_s)):
            if reference.on[i] == own.on[j]:
                shift = float(own.time_s[j] - reference.time_s[i])
                pairs = _pairs(reference, own, shift)
                best.append((len(pairs), shift, pairs))
    if not best:
        raise InputError(f"camera '{name}': its flashes are none of the reference camera's; film them together")
    best.sort(key=lambda one: -one[0])
    most, shift, pairs = best[0]
    reach = _reach(reference, own)
    others = [n for n, other, _ in best if abs(other - shift) > 4 * reach]
    if most < FEWEST_EDGES or (others and others[0] > AS_GOOD * most):
        raise InputError(
            f"camera '{name}': its flashes fit the reference camera's at more than one place ({most} edges each); "
            "flash at irregular times"
        )
    return pairs, shift


def _pairs(reference: Edges, own: Edges, shift: float) -> Array:
    pairs = []
    for i in range(len(reference.time_s)):
        wanted = reference.time_s[i] + shift
        j = int(np.argmin(np.abs(own.time_s - wanted)))
        reach = SURE_SIGMAS * math.hypot(reference.sigma_s[i], own.sigma_s[j]) + AGREE_S
        reach += LARGEST_DRIFT * abs(float(np.ptp(reference.time_s)))
        if reference.on[i] == own.on[j] and abs(own.time_s[j] - wanted) < reach:
            pairs.append((i, j))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _reach(reference: Edges, own: Edges) -> float:
    widest = SURE_SIGMAS * math.hypot(float(reference.sigma_s.max()), float(own.sigma_s.max()))
    return widest + AGREE_S + LARGEST_DRIFT * float(np.ptp(reference.time_s))


def _spread(values: Array) -> float:
    """Return a standard deviation of ``values`` that is robust against a few half-lit frames."""
    if len(values) < 2:
        return 0.0
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))
