"""C3D with markers, joint centres and joint angles: angles are points listed in ``POINT:ANGLES``, in degrees.

Such a point is named as in Vicon's Plug-in Gait (``LHipAngles``, ``RKneeAngles``; in the middle of the body
``PelvisAngles``, ``SpineAngles``, ``NeckAngles``). Its x, y, z are the joint's three angles in the order and with the
signs of ``mosca.skeleton.isb_angles``. At the hip, knee and ankle, flexion, adduction and internal rotation are
positive as in Plug-in Gait. At the pelvis, spine, shoulder, elbow and wrist, sequence and signs are not Vicon's. A
C3D file has no place for the angles' standard deviations.
"""

from pathlib import Path

import numpy as np

from mosca.data.files.whole_file import whole_file
from mosca.data.joint_angles import JointAngles
from mosca.data.joint_motion import JOINTS, JointMotion
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.joints.centre_tracks import centres_as_tracks
from mosca.formats.tracks.c3d import c3d_document
from mosca.formats.tracks.marker_table import table_from_tracks


def write_joints_c3d(
    path: Path, motion: JointMotion, angles: JointAngles, frame_rate_hz: float, markers: Tracks | None = None
) -> None:
    """Write joint centres, those joints' angles and ``markers`` as C3D, whole or not at all.

    Raises InputError where there is no centre and no marker, more than a C3D file can count, or angles are known in
    frames before or after all points.
    """
    path = Path(path)
    if not 0 < frame_rate_hz < np.inf:
        raise InputError(f"{path}: a frame rate of {frame_rate_hz:g}/s given; one above 0 is wanted")
    points = centres_as_tracks(motion)
    table = table_from_tracks(points if markers is None else _together(markers, points), frame_rate_hz)
    document = c3d_document(table, path)
    triples = {_label(joint): places for joint in JOINTS if (places := _places(joint, angles))}
    values = np.full((4, len(triples), len(table.xyz)), np.nan)
    row = angles.frame - table.first_frame
    inside = (row >= 0) & (row < len(table.xyz))
    for k, places in enumerate(triples.values()):
        known = np.isfinite(angles.angles[:, places]).all(axis=1)
        if (known & ~inside).any():
            frame = angles.frame[np.flatnonzero(known & ~inside)[0]]
            raise InputError(f"{path}: angles in frame {frame}, where no point is; leave out frames without points")
        values[:3, k, row[known]] = np.rad2deg(angles.angles[known][:, places]).T
    values[3] = 1.0
    data, point = document["data"], document["parameters"]["POINT"]
    residual = np.where(np.isnan(values[:1]), -1.0, 0.0)
    data["points"] = np.concatenate([data["points"], values], axis=1)
    data["meta_points"]["residuals"] = np.concatenate([data["meta_points"]["residuals"], residual], axis=1)
    data["meta_points"]["camera_masks"] = np.zeros((7, *data["points"].shape[1:]), dtype=bool)
    point["LABELS"]["value"] = [*point["LABELS"]["value"], *triples]
    document.add_parameter("POINT", "ANGLES", list(triples))
    document.add_parameter("POINT", "ANGLE_UNITS", ["deg"])
    with whole_file(path) as temporary:
        document.write(str(temporary))


def _together(markers: Tracks, centres: Tracks) -> Tracks:
    """Return tracks of both, numbered apart."""
    columns = {name: [getattr(one, name) for one in (markers, centres)] for name in Tracks.__dataclass_fields__}
    columns["track"][1] = columns["track"][1] + 1 + max(markers.track, default=0)
    both = {name: np.concatenate(parts) for name, parts in columns.items()}
    return Tracks(**both).select(np.lexsort((both["track"], both["frame"])))


def _places(joint: str, angles: JointAngles) -> list[int]:
    """Return the indices of a joint's three angles in ``angles``; none where it does not have three."""
    places = [k for k, name in enumerate(angles.names) if name.startswith(f"{joint}_")]
    return places if len(places) == 3 else []


def _label(joint: str) -> str:
    side, kind = (joint[0].upper(), joint[2:]) if joint[1] == "_" else ("", joint)
    return f"{side}{'Spine' if kind == 'lumbar' else kind.capitalize()}Angles"
