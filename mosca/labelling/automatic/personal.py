"""Template of one person, from a labelled take with the same markers, for instance of a static pose.

Pose and size of the general template's person are fitted to the frame that shows most markers. The personal template
has the segment sizes of the person and the place of each marker on them; only movement of the skin remains open.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.labelling.automatic.body import FittedPose, TemplateBody
from mosca.labelling.automatic.matching import SOFT_SHARE, pair_statistics
from mosca.labelling.automatic.template import IN_A_SET, BodyVariation, MarkerTemplate

SKIN_M = 0.01
"""Standard deviation of a marker's movement on a person's segment: 5 to 20 mm (A. Leardini et al., Gait & Posture 21,
2005, p. 212)."""
FEWEST = 8
"""Least number of the take's markers that the template has."""
FITS = 30
"""Gauss-Newton steps from the standing person."""


def personal_template(take: Tracks, template: MarkerTemplate, where: str) -> MarkerTemplate:
    """Return the template of the person in a labelled ``take``, with its markers and their names.

    A marker whose name is not in ``template`` (and its sets) is put on the segment of the known marker to which its
    distance changes least. ``where``: the take's name in messages. InputError where too few names are known.
    """
    names, xyz = _markers(take, where)
    known = _known(names, template)
    if (known >= 0).sum() < FEWEST:
        raise InputError(
            f"{where}: {(known >= 0).sum()} labels that the template has, {FEWEST} or more are wanted; it has "
            + ", ".join(template.names)
        )
    shown = np.isfinite(xyz[:, :, 0])
    frame = int((shown[:, known >= 0].sum(axis=1) * xyz.shape[1] + shown.sum(axis=1)).argmax())
    body = TemplateBody(template)
    pose = _fitted(body, xyz[frame], known)
    segment = _segments(xyz, known, template)
    there = np.flatnonzero(shown[frame])
    joints, origin, turns, error = _skeleton(body, pose)
    of = segment[there]
    own = (turns[of].transpose(0, 2, 1) @ (xyz[frame, there] - origin[of])[:, :, None])[:, :, 0]
    at = {int(marker): k for k, marker in enumerate(known[there]) if marker >= 0}
    other = [
        at.get(int(template.other_side[marker]), k) if marker >= 0 else k for k, marker in enumerate(known[there])
    ]
    return replace(
        template,
        names=tuple(names[k] for k in there.tolist()),
        segment=of,
        place_m=joints[of] + own,
        spread_m=np.full((len(there), 3), SKIN_M),
        share=np.full(len(there), IN_A_SET),
        other_side=np.array(other),
        beside=np.full(len(there), -1),
        joint_m=joints,
        sets=(),
        variation=BodyVariation(error, error),
    )


def _markers(take: Tracks, where: str) -> tuple[list[str], Array]:
    """Return names (n) and positions (t, n, 3), NaN where not seen."""
    named = np.flatnonzero((take.label != "") & (take.status == "measured"))
    if not len(named):
        raise InputError(f"{where}: no sample has a label; name its markers, or leave --static out")
    own, column = np.unique(take.label[named], return_inverse=True)
    frames, row = np.unique(take.frame[named], return_inverse=True)
    xyz = np.full((len(frames), len(own), 3), np.nan)
    xyz[row, column] = take.xyz[named]
    return own.tolist(), xyz


def _known(names: list[str], template: MarkerTemplate) -> Array:
    """Return the template's marker (n,) of each name, -1 for none, by the set that has most of the names."""
    called = [template.names, *(one.names for one in template.sets)]
    short = [name.split(":")[-1] for name in names]
    found = [np.array([those.index(name) if name in those else -1 for name in short]) for those in called]
    best = max(found, key=lambda one: int((one >= 0).sum()))
    # of two labels of one marker use the first
    _, first = np.unique(best, return_index=True)
    out = np.full(len(best), -1)
    out[first] = best[first]
    return out


def _fitted(body: TemplateBody, points: Array, known: Array) -> FittedPose:
    there = np.flatnonzero((known >= 0) & np.isfinite(points[:, 0]))
    to = np.zeros((len(body.template.names), 3))
    weight = np.zeros(len(to))
    to[known[there]], weight[known[there]] = points[there], 1.0
    places = body.template.place_m[known[there]]
    whole, _ = Rotation.align_vectors(points[there] - points[there].mean(axis=0), places - places.mean(axis=0))
    return body.fit(body.start(whole.as_matrix(), np.median(points[there], axis=0)), to, weight, FITS)


def _segments(xyz: Array, known: Array, template: MarkerTemplate) -> Array:
    """Return the segment (n,) of each marker of a take (t, n, 3)."""
    away, change = pair_statistics(xyz)
    cost = np.nan_to_num(change) + SOFT_SHARE * away
    cost[:, known < 0] = np.inf
    nearest = known[np.where(np.isfinite(cost), cost, np.inf).argmin(axis=1)]
    return np.asarray(template.segment[np.where(known >= 0, known, nearest)])


def _skeleton(body: TemplateBody, pose: FittedPose) -> tuple[Array, Array, Array, float]:
    """Return joints (g, 3) of the person standing and in the pose, turns (g, 3, 3), and the error of the sizes."""
    template, g = body.template, body.g
    origin, turns = body.frames(pose)
    size = np.exp(pose.parameters[6 + 3 * g] + pose.parameters[7 + 3 * g :])
    joints = template.joint_m.copy()
    for k in range(1, g):
        parent = int(template.parent[k])
        joints[k] = joints[parent] + (template.joint_m[k] - template.joint_m[parent]) * size[parent]
    error = np.sqrt(np.diag(pose.unknown)[7 + 3 * g :].mean())
    return joints, origin, turns, float(error)
