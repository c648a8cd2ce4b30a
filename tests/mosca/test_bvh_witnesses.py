"""Other programs see the joints of our BVH files where they are: bvhio, and Blender as a Python module."""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from test_formats_bodies import some_motion

from mosca.data.motion.motion import Motion, forward_kinematics
from mosca.formats.bodies.bvh_writer import write_bvh

HUNDREDTH_MM = 1e-5
"""Both compute in float32, 6e-8 of some metres; a tenth of the 0.1 mm that is asked for."""
BLENDER = """
import bpy, json, sys
bpy.ops.import_anim.bvh(filepath=sys.argv[1], global_scale=0.01, axis_forward="-Z", axis_up="Y", frame_start=1)
body = bpy.context.object
places = {bone.name: [] for bone in body.pose.bones}
for frame in range(1, int(body.animation_data.action.frame_range[1]) + 1):
    bpy.context.scene.frame_set(frame)
    for bone in body.pose.bones:
        places[bone.name].append(list(body.matrix_world @ bone.head))
print("places " + json.dumps(places))
"""


def check(motion: Motion, places: dict[str, np.ndarray]) -> None:
    """Compare world positions (t, 3) [m] of all joints but ends of bones, which others name as they like."""
    ours, names = forward_kinematics(motion)[0], motion.skeleton.names
    assert set(places) == {name for name in names if not name.endswith("_end")}
    for name, theirs in places.items():
        np.testing.assert_allclose(theirs, ours[:, names.index(name)], atol=HUNDREDTH_MM)


def test_bvhio_sees_the_same_joints(tmp_path: Path) -> None:
    bvhio = pytest.importorskip("bvhio", reason="bvhio is not installed: pip install -e '.[bench]'")
    motion = some_motion()
    write_bvh(motion, tmp_path / "a.bvh")
    root = bvhio.readAsHierarchy(str(tmp_path / "a.bvh"))
    places: dict[str, list[list[float]]] = {}
    for frame in range(len(motion.root_xyz)):
        root.loadPose(frame)
        for joint, _, _ in root.layout():
            x, y, z = joint.PositionWorld
            places.setdefault(joint.Name, []).append([x, -z, y])
    check(motion, {name: 0.01 * np.array(paths) for name, paths in places.items()})


@pytest.mark.slow
def test_blender_sees_the_same_joints(tmp_path: Path) -> None:
    python = os.environ.get("MOSCA_BLENDER_PYTHON")
    if not python:
        pytest.skip(
            "MOSCA_BLENDER_PYTHON names no interpreter with Blender: pip install bpy in an environment of its own"
        )
    motion = some_motion()
    write_bvh(motion, tmp_path / "a.bvh")
    command = [python, "-c", BLENDER, str(tmp_path / "a.bvh")]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    line = next(line for line in run.stdout.splitlines() if line.startswith("places "))
    check(motion, {name: np.array(paths) for name, paths in json.loads(line[7:]).items()})
