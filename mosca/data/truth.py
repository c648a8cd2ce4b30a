"""Ground truth. Only the twin makes it and only scenarios read it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.data.files.npz import from_npz, whole_numbers, write_npz_file

NO_FRAME = int(np.iinfo(np.int64).min)
"""Mid-exposure entered for a camera that took no frame from a pulse until the next [ns]."""
FRAMES = "frames."
"""Prefix of the names of the frames' arrays in the file."""
JOINTS = "joints."
"""Prefix of the names of the joints' arrays in the file."""
TABLES = ("frames", "joints")
"""Fields of Truth that are no arrays themselves."""


@dataclass(frozen=True, eq=False)
class FramesTruth:
    """Ground truth at the n frames of the free-running cameras, one row a frame, with m markers.

    ``camera`` (n,) number in ``Truth.cameras``; ``index`` (n,) the camera's own counter; ``stamp_ns`` (n,) the
    camera's own stamp; ``exposure_mid_ns`` (n,) the true mid-exposure, session clock; ``xyz`` (n, m, 3) marker
    centres at that instant, world frame [m]; ``visible`` (n, m), ``image_xy_px`` (n, m, 2), ``diameter_px`` (n, m)
    as in Truth;
    ``camera_rotation`` (n, 3, 3), ``camera_position`` (n, 3): ``world_from_camera`` at the true mid-exposure.
    """

    camera: Array
    index: Array
    stamp_ns: Array
    exposure_mid_ns: Array
    xyz: Array
    visible: Array
    image_xy_px: Array
    diameter_px: Array
    camera_rotation: Array
    camera_position: Array

    def __post_init__(self) -> None:
        n = len(np.asarray(self.camera))
        m = np.shape(self.visible)[1]
        set_read_only(self, np.int64, camera=(n,), index=(n,), stamp_ns=(n,), exposure_mid_ns=(n,))
        set_read_only(self, xyz=(n, m, 3), visible=(n, m), image_xy_px=(n, m, 2), diameter_px=(n, m))
        set_read_only(self, camera_rotation=(n, 3, 3), camera_position=(n, 3))


@dataclass(frozen=True, eq=False)
class JointTruth:
    """True centres and rotations of a person's j joints at the t pulses of a Truth.

    The axes of each segment are attached to its bone and follow from landmarks in the rest pose, so that estimators
    without the model can be compared with them (after Wu et al. 2002 and 2005: x forward, y up, z to the right in the
    anatomical position). Landmarks are the centres of the markers of that name where they were placed, not moved by
    the skin; hip, knee, ... are the joints' centres; ``mid`` is the middle of points, ``x`` the cross product. An
    axis that is not perpendicular to another one is made so.

    - pelvis: z LASI -> RASI; x mid(LPSI, RPSI) -> mid(LASI, RASI); y = z x x. Its centre: mid(left hip, right hip).
    - thorax: y mid(STRN, T10) -> mid(CLAV, C7); z normal to the plane of CLAV, C7 and mid(STRN, T10); x = y x z.
    - head: x mid(LBHD, RBHD) -> mid(LFHD, RFHD); z mid(LFHD, LBHD) -> mid(RFHD, RBHD); y = z x x.
    - thigh: y knee -> hip; z the knee's axis of flexion; x = y x z. Shank: y ankle -> knee; z and x likewise.
    - foot: x HEE -> TOE; z along TOE -> MT5 (left: MT5 -> TOE); y = z x x.
    - upper arm: y elbow -> shoulder; z the elbow's axis of flexion; x = y x z.
    - forearm: y wrist -> elbow; z along WRB -> WRA (left: WRA -> WRB), on the bone that carries them, so that the
      elbow's rotation includes pronation; x = y x z.
    - hand: y mid(FIN, PNK) -> wrist; z along PNK -> FIN (left: FIN -> PNK); x = y x z.

    An axis of flexion is that of the hinge where the joint is one, else the direction that is most nearly common to
    both bones during the motion (Ehrig et al. 2007). It points to the right in the anatomical position: knees flex
    about -z, elbows about +z.

    Rotations: pelvis world_from_pelvis, lumbar pelvis_from_thorax, neck thorax_from_head, hip pelvis_from_thigh, knee
    thigh_from_shank, ankle shank_from_foot, shoulder thorax_from_upper arm, elbow upper arm_from_forearm, wrist
    forearm_from_hand.
    """

    names: tuple[str, ...]
    """Names of the j joints, among ``mosca.data.joint_motion.JOINTS``."""
    centre: Array
    """(t, j, 3) in the world [m]; NaN where a joint has no single one (lumbar, neck)."""
    rotation: Array
    """(t, j, 4) unit quaternion wxyz, w >= 0, of proximal_from_distal; NaN where a landmark or an axis is missing."""

    def __post_init__(self) -> None:
        t, j = len(np.asarray(self.centre)), len(self.names)
        object.__setattr__(self, "names", tuple(self.names))
        set_read_only(self, centre=(t, j, 3), rotation=(t, j, 4))
        if len(set(self.names)) < j:
            raise ValueError(f"joints: {len(set(self.names))} names for {j} joints; each has one of its own")


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth at each pulse.

    A free-running camera is entered with its frame nearest to the pulse. Where it took no frame until the next pulse,
    it is entered with NO_FRAME, nothing visible and NaN.
    """

    time_ns: Array
    """(t,) nominal mid-exposure of the pulse, session clock: the instant of its positions."""
    names: tuple[str, ...]
    """Names of the m markers."""
    xyz: Array
    """(t, m, 3) marker centres in the world [m]."""
    visible: Array
    """(t, m, c) share of the marker's disc that camera c could see (0..1; outside the image 0)."""
    cameras: tuple[str, ...]
    """Names of the c cameras."""
    image_xy_px: Array
    """(t, m, c, 2) true image of the marker *centre*, NaN where the camera does not see it; with a rolling shutter,
    at the mid-exposure of the marker's own rows."""
    diameter_px: Array
    """(t, m, c) diameter of the whole disc's image."""
    exposure_mid_ns: Array
    """(t, c) true mid-exposure of each camera's frame, session clock."""
    camera_rotation: Array | None = None
    """(t, c, 3, 3) rotation of the true ``world_from_camera`` at that instant; None where not kept (older files)."""
    camera_position: Array | None = None
    """(t, c, 3) translation of the true ``world_from_camera`` [m]."""
    frames: FramesTruth | None = None
    """All frames of free-running cameras; None where all are triggered."""
    joints: JointTruth | None = None
    """The joints at the pulses; None where the scene is no person, and in older files."""

    def __post_init__(self) -> None:
        t, m, c = len(np.asarray(self.time_ns)), len(self.names), len(self.cameras)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "cameras", tuple(self.cameras))
        set_read_only(self, np.int64, time_ns=(t,), exposure_mid_ns=(t, c))
        set_read_only(self, xyz=(t, m, 3), visible=(t, m, c), image_xy_px=(t, m, c, 2), diameter_px=(t, m, c))
        if self.camera_rotation is not None:
            set_read_only(self, camera_rotation=(t, c, 3, 3))
        if self.camera_position is not None:
            set_read_only(self, camera_position=(t, c, 3))
        if self.joints is not None and len(self.joints.centre) != t:
            raise ValueError(f"joints: {len(self.joints.centre)} instants given for {t} pulses")


def write_truth(truth: Truth, path: Path) -> None:
    """Write all fields under their names (numpy .npz, no pickles); those of ``frames`` as ``frames.NAME``.

    Those of ``joints`` as ``joints.NAME``.
    """
    fields = {name: getattr(truth, name) for name in Truth.__dataclass_fields__ if name not in TABLES}
    for prefix, table in ((FRAMES, truth.frames), (JOINTS, truth.joints)):
        if table is not None:
            fields |= {prefix + name: getattr(table, name) for name in table.__dataclass_fields__}
    arrays = {name: np.asarray(value) for name, value in fields.items() if value is not None}
    write_npz_file(path, arrays)


def read_truth(path: Path) -> Truth:
    """Read what ``write_truth`` wrote, now or before cameras' poses, frames and joints were kept.

    Raises InputError for a file that is missing or holds something else.
    """
    return from_npz(path, _truth_of, "truth", "'mosca run --record'")


def _truth_of(fields: Mapping[str, Array]) -> Truth:
    whole_numbers(fields, "time_ns", "exposure_mid_ns")
    later = ("camera_rotation", "camera_position")
    values: dict[str, Any] = {
        name: fields[name]
        for name in Truth.__dataclass_fields__
        if name not in TABLES and (name in fields or name not in later)
    }
    if FRAMES + "camera" in fields:
        values["frames"] = FramesTruth(**{name: fields[FRAMES + name] for name in FramesTruth.__dataclass_fields__})
    if JOINTS + "names" in fields:
        names = tuple(str(n) for n in fields[JOINTS + "names"])
        values["joints"] = JointTruth(names, fields[JOINTS + "centre"], fields[JOINTS + "rotation"])
    values["names"] = tuple(str(n) for n in values["names"])
    values["cameras"] = tuple(str(n) for n in values["cameras"])
    return Truth(**values)
