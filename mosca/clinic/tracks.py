"""Causes that tracks show: wrong scale, lengths that change with place, labels or bodies that are exchanged."""

from collections.abc import Mapping, Sequence

import numpy as np

from mosca.clinic.causes import Diagnosis
from mosca.clinic.observations import PointImages
from mosca.data.arrays import Array
from mosca.data.distributions import chi2, norm
from mosca.data.tracks import Tracks
from mosca.diagnostics.long_run_covariance import long_run_covariance

NEAR = 0.35
"""A measured length is taken for the stated one if it differs from it by less than this share."""
TAPE_M = 1e-3
"""Standard deviation of a length that a person states [m]: reading a tape, EU class II, at both ends."""
WEAK = 0.01
"""Relative change of a length over the volume from which a calibration is weak."""
RIGID = 0.05
"""A length that scatters by less than this share is one of a rigid body."""
JUMP_SIGMAS = 6.0
"""Jump of a label away from its prediction, in standard deviations of all labels' predictions."""
BACK = 0.25
"""Exchanged labels deviate from each other's path by at most this share of the jump."""


def length_causes(observed: PointImages, known_m: Sequence[float], sigma_m: float, alpha: float) -> list[Diagnosis]:
    """Return the faults that stated lengths [m] of rigid pairs show: a wrong scale, or one that varies by place."""
    found: list[Diagnosis] = []
    for stated in known_m:
        pair = rigid_pair(observed, stated)
        if pair is None:
            continue
        vector, place = pair
        length = np.linalg.norm(vector, axis=1)
        measured = float(np.median(length))
        ratio = measured / stated
        n = max(len(length) / 10, 2.0)
        sigma = np.hypot(float(np.std(length)) / np.sqrt(n), sigma_m)
        chance = float(2 * norm.sf(abs(measured - stated) / sigma))
        weak = _changing(vector, place, length, alpha)
        if weak is not None:
            found.append(weak)
        elif chance < alpha:
            text = (
                f"the length of {1e3 * stated:.1f} mm is measured as {1e3 * measured:.1f} mm, {100 * ratio:.2f} % of "
                f"it ({1e3 * sigma:.2f} mm standard deviation, of which the stated length {1e3 * sigma_m:g}; "
                f"p = {chance:.1g}), at every place alike"
            )
            found.append(Diagnosis("wrong-scale", chance, (text,), figures={"ratio": ratio}))
    return found


def rigid_pair(observed: PointImages, stated_m: float) -> tuple[Array, Array] | None:
    """Return vectors and middles (n, 3) [m] of the two tracks whose distance is nearest to the stated one, among
    pairs whose distance is constant; None where there are none.
    """
    names, counts = np.unique(observed.track, return_counts=True)
    names = names[counts >= max(20, 0.3 * counts.max(initial=0))]
    of = {}
    for name in names:
        rows = observed.track == name
        of[int(name)] = dict(zip(observed.frame[rows].tolist(), observed.xyz[rows], strict=True))
    best = None
    for i, a in enumerate(of):
        for b in list(of)[i + 1 :]:
            common = sorted(set(of[a]) & set(of[b]))
            if len(common) < 20:
                continue
            first = np.array([of[a][f] for f in common])
            second = np.array([of[b][f] for f in common])
            length = np.linalg.norm(second - first, axis=1)
            scatter = float(np.std(length) / np.mean(length))
            off = abs(np.log(np.median(length) / stated_m))
            if scatter < RIGID and off < NEAR and (best is None or off < best[0]):
                best = (off, second - first, 0.5 * (first + second))
    return None if best is None else best[1:]


def _changing(vector: Array, place: Array, length: Array, alpha: float) -> Diagnosis | None:
    """Return a diagnosis where a length changes with place or direction: regression with dependent residuals."""
    unit = vector / length[:, None]
    away = (place - place.mean(axis=0)) / max(float(place.std()), 1e-9)
    design = np.column_stack(
        [np.ones(len(length)), away, unit[:, :2] ** 2, unit[:, :1] * unit[:, 1:], unit[:, 1] * unit[:, 2]]
    )
    values = np.linalg.lstsq(design, length / length.mean(), rcond=None)[0]
    rest = length / length.mean() - design @ values
    inverse = np.linalg.pinv(design.T @ design)
    covariance = inverse @ long_run_covariance(design * rest[:, None]) @ inverse
    part = values[1:]
    wald = float(part @ np.linalg.pinv(covariance[1:, 1:], hermitian=True) @ part)
    chance = float(chi2.sf(wald, len(part)))
    low, high = np.quantile(design @ values, [0.05, 0.95])
    if chance > alpha or high - low < WEAK:
        return None
    text = (
        f"a rigid length changes by {100 * (high - low):.1f} % with place and direction ({100 * WEAK:g} % allowed, "
        f"p = {chance:.1g}), although rays meet"
    )
    return Diagnosis("weak-calibration", chance, (text,), figures={"change": float(high - low)})


def label_causes(tracks: Tracks, alpha: float) -> list[Diagnosis]:
    """Return exchanges of labels; they count as exchanges of bodies where three or more labels of one body take part.

    A label's body is the part before its last ':' or '_'.
    """
    labelled = tracks.select((tracks.label != "") & (tracks.status == "measured"))
    return swap_causes(places_of(labelled.label, labelled.frame, labelled.xyz), alpha)


def places_of(names: Array, frames: Array, xyz: Array) -> dict[str, dict[int, Array]]:
    """Return name -> frame -> place."""
    places: dict[str, dict[int, Array]] = {}
    for name, frame, at in zip(names.tolist(), frames.tolist(), xyz, strict=True):
        places.setdefault(name, {})[frame] = at
    return places


def swap_causes(places: Mapping[str, Mapping[int, Array]], alpha: float, bodies: bool = False) -> list[Diagnosis]:
    """Return exchanges of the places of two names; ``bodies``: whether the names are those of bodies."""
    jumps = {name: _jumps(of) for name, of in places.items()}
    sizes = np.array([size for one in jumps.values() for size, _, _ in one.values()])
    if len(sizes) < 20:
        return []
    sigma = 1.4826 * float(np.median(sizes)) / 1.5382  # median of a 3D normal's length is 1.5382 sigma
    found: dict[int, list[tuple[str, str, float]]] = {}
    names = list(places)
    for i, a in enumerate(names):
        for frame, (size, predicted, at) in jumps[a].items():
            if size < JUMP_SIGMAS * sigma:
                continue
            for b in names[i + 1 :]:
                if frame not in jumps[b]:
                    continue
                other, other_predicted, other_at = jumps[b][frame]
                crossed = np.linalg.norm(at - other_predicted) + np.linalg.norm(other_at - predicted)
                if other > JUMP_SIGMAS * sigma and crossed < BACK * (size + other):
                    found.setdefault(frame, []).append((a, b, float(size)))
    if not found:
        return []
    frame, pairs = next(iter(sorted(found.items())))
    owners = {(_body(a), _body(b)) for a, b, _ in pairs}
    whole = bodies or (len(pairs) >= 3 and len(owners) == 1 and next(iter(owners))[0] != next(iter(owners))[1])
    jump = max(size for _, _, size in pairs)
    chance = min(1.0, float(chi2.sf((jump / sigma) ** 2, 3)) * len(sizes) * max(len(names), 2))
    told = ", ".join(f"{a} and {b}" for a, b, _ in pairs[:4])
    text = (
        f"at frame {frame} {told} jump {1e3 * jump:.1f} mm into each other's path ({1e3 * JUMP_SIGMAS * sigma:.1f} "
        f"mm allowed, p = {chance:.1g})" + (f"; {len(found)} such frames" if len(found) > 1 else "")
    )
    code = "bodies-swapped" if whole else "labels-swapped"
    return [Diagnosis(code, chance, (text,), figures={"frame": float(frame)})] if chance < alpha else []


def _body(name: str) -> str:
    return name.replace("_", ":").rpartition(":")[0]


def _jumps(of: Mapping[int, Array]) -> dict[int, tuple[float, Array, Array]]:
    """Return frame -> distance of a position from the line through the two before it, prediction, position."""
    return {
        frame: (
            float(np.linalg.norm(at - (2 * of[frame - 1] - of[frame - 2]))),
            2 * of[frame - 1] - of[frame - 2],
            at,
        )
        for frame, at in of.items()
        if frame - 1 in of and frame - 2 in of
    }
