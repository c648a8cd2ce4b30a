"""OpenSim's files: coordinates over time (.mot) and scale sets (.xml).

Ground in OpenSim has x forward, y up and z to the right: world (x, y, z) -> (x, z, -y), so that a subject who walks
towards the world's +x walks forward. ``COORDINATES`` lists which of our angles are coordinates of its gait models.
Pelvis, lumbar and hip are equal by definition (Z-X'-Y'', axes and order in subject01_simbody.osim). Others differ:

- ``pelvis_tx, _ty, _tz`` are of the origin of the model's pelvis, midway between the anterior superior iliac spines.
  Our origin is midway between the hips; ``hips_in_pelvis_m`` is its position in the model's pelvis.
- ``knee_angle``: positive in extension in gait2354 and gait2392, in flexion in Rajagopal's. The models' knee has no
  other degree of freedom: adduction and internal rotation follow from it and are left out.
- ``ankle_angle`` rotates about an axis 12 degrees off the foot's z. The dorsiflexion written for it is 2 % smaller
  while the subtalar joint rests. ``subtalar_angle`` mixes inversion and internal rotation about an oblique
  axis and is left out, as are toes.
- Arms of Rajagopal's model (``arm_flex, arm_add, arm_rot``: Z-X'-Y'' from a hanging arm) are no ISB shoulder angles;
  its elbow and wrist have oblique axes. All of these are left out.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.whole_file import whole_file, write_text
from mosca.data.joint_angles import JointAngles
from mosca.data.joint_motion import JointMotion
from mosca.data.motion.motion import WORLD_FROM_Y_UP, matrices_from_quaternions
from mosca.errors import InputError

KNEE_SIGNS = {"gait2354": -1, "gait2392": -1, "Rajagopal": 1}
"""Models, and the sign of knee flexion in their ``knee_angle``."""
_MIDDLE = {
    "pelvis_tilt": ("pelvis_tilt", -1),
    "pelvis_list": ("pelvis_obliquity", 1),
    "pelvis_rotation": ("pelvis_rotation", 1),
    "lumbar_extension": ("lumbar_flexion", -1),
    "lumbar_bending": ("lumbar_bending", 1),
    "lumbar_rotation": ("lumbar_rotation", 1),
}
_SIDE = {
    "hip_flexion": "hip_flexion",
    "hip_adduction": "hip_adduction",
    "hip_rotation": "hip_internal_rotation",
    "knee_angle": "knee_flexion",
    "ankle_angle": "ankle_dorsiflexion",
}
COORDINATES: Mapping[str, tuple[str, int]] = _MIDDLE | {
    f"{theirs}_{side}": (f"{side}_{ours}", 1) for side in "rl" for theirs, ours in _SIDE.items()
}
"""OpenSim's coordinate -> our angle and its sign; ``KNEE_SIGNS`` multiplies that of the knees."""


def write_mot(
    angles: JointAngles,
    path: Path,
    *,
    model: str = "Rajagopal",
    pelvis: JointMotion | None = None,
    hips_in_pelvis_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> None:
    """Write the angles listed in ``COORDINATES`` as an OpenSim motion in degrees, whole or not at all.

    Time is in seconds from the first frame. Raises InputError for an unknown model, where no angle is listed, and
    where a value is unknown in any frame: OpenSim accepts no gaps.

    Parameters
    ----------
    angles
        From ``isb_angles`` with heading 0, so that ground is the world.
    path
        A .mot file.
    model
        One of ``KNEE_SIGNS``.
    pelvis
        Joints at the same instants: pelvis_tx, pelvis_ty and pelvis_tz [m] are written too.
    hips_in_pelvis_m
        The point midway between the hips in the model's pelvis, scaled to the subject: in gait2354 (-0.0707, -0.0661,
        0) before scaling. With 0, pelvis_tx, _ty, _tz are those of that point itself.
    """
    path = Path(path)
    if model not in KNEE_SIGNS:
        raise InputError(f"{path}: model {model!r} given; {', '.join(KNEE_SIGNS)} are known")
    columns: dict[str, Array] = {}
    for coordinate, (name, sign) in COORDINATES.items():
        if name in angles.names:
            factor = sign * (KNEE_SIGNS[model] if coordinate.startswith("knee") else 1)
            columns[coordinate] = factor * np.rad2deg(angles.angles[:, angles.names.index(name)])
    if pelvis is not None:
        columns |= _translation(angles, pelvis, np.asarray(hips_in_pelvis_m, dtype=np.float64), path)
    if not columns or not len(angles):
        raise InputError(
            f"{path}: no angle to write; wanted are some of {', '.join(n for n, _ in COORDINATES.values())}"
        )
    for coordinate, values in columns.items():
        if not np.isfinite(values).all():
            frame = angles.frame[np.flatnonzero(~np.isfinite(values))[0]]
            raise InputError(f"{path}: {coordinate} is unknown in frame {frame}; fill the gaps or leave frames out")
    time_s = 1e-9 * (angles.time_ns - angles.time_ns[0])
    table = np.column_stack([time_s, *columns.values()])
    lines = ["Coordinates", "version=1", f"nRows={len(table)}", f"nColumns={table.shape[1]}", "inDegrees=yes", ""]
    lines += ["endheader", "\t".join(("time", *columns))]
    lines += ["\t".join(map(repr, row)) for row in table.tolist()]
    write_text(path, "\n".join(lines) + "\n")


def write_scale_set(scales: Mapping[str, tuple[float, float, float]], path: Path) -> None:
    """Write an OpenSim scale set, whole or not at all, for its scale tool's ``ModelScaler``, order "manualScale".

    ``scales``: body of the model ("femur_r") -> ratio of its length to that in the generic model, along the body's x,
    y, z. Raises InputError for no scales, a body without a name, and a factor that is not above 0.
    """
    path = Path(path)
    for body, factors in scales.items():
        if not body.strip() or len(factors) != 3 or not all(0 < factor < np.inf for factor in factors):
            raise InputError(f"{path}: body {body!r} with factors {tuple(factors)}; a name and 3 above 0 are wanted")
    if not scales:
        raise InputError(f"{path}: no body to scale; give a factor along x, y, z for one at least")
    document = ElementTree.Element("OpenSimDocument", Version="40000")
    objects = ElementTree.SubElement(ElementTree.SubElement(document, "ScaleSet", name="scales"), "objects")
    for body, factors in scales.items():
        scale = ElementTree.SubElement(objects, "Scale")
        ElementTree.SubElement(scale, "scales").text = " ".join(repr(float(factor)) for factor in factors)
        ElementTree.SubElement(scale, "segment").text = body.strip()
        ElementTree.SubElement(scale, "apply").text = "true"
    ElementTree.indent(document)
    with whole_file(path) as temporary:
        ElementTree.ElementTree(document).write(temporary, encoding="UTF-8", xml_declaration=True)


def _translation(angles: JointAngles, pelvis: JointMotion, hips_in_pelvis_m: Array, path: Path) -> dict[str, Array]:
    """Return the columns of the pelvis' origin in ground [m]."""
    if "pelvis" not in pelvis.joints or not np.array_equal(pelvis.frame, angles.frame):
        raise InputError(
            f"{path}: the joints given have no pelvis in each frame of the angles; give those they are of"
        )
    k = pelvis.joints.index("pelvis")
    origin = pelvis.centre[:, k] - matrices_from_quaternions(pelvis.rotation[:, k]) @ hips_in_pelvis_m
    return dict(zip(("pelvis_tx", "pelvis_ty", "pelvis_tz"), (origin @ WORLD_FROM_Y_UP).T, strict=True))
