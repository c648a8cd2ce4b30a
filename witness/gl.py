"""One small scene through OpenGL: MuJoCo's own renderer and pyrender, at their best supersampling.

It runs as a program, because the GL platform must be chosen before anything is imported:
``python witness/gl.py mujoco|pyrender OUT.npy``. The scene has white balls and discs and black obstacles on black.
The camera frame is the world (x right, y down, z forward). GL counts pixels from their edges: the middle of the image
lies at (W / 2, H / 2), which is (W - 1) / 2, (H - 1) / 2 here.
"""

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

Array = NDArray[Any]
WIDTH, HEIGHT, FOCAL_PX, FINE = 160, 120, 300.0, 16
BALLS = (((-0.28, -0.16, 1.5), 0.02), ((0.0, 0.02, 1.2), 0.041), ((0.3, 0.18, 1.6), 0.0107))
"""Centre [m] and radius of white balls."""
DISCS = (((0.29, -0.17, 1.5), (0.4, -0.3, -0.86), 0.03), ((-0.27, 0.17, 1.4), (-0.1, 0.6, -0.8), 0.025))
"""Centre [m], normal and radius of white flat discs."""
BOX = ((-0.137, -0.11, 0.9), (0.03, 0.05, 0.004))
"""A black box before the first ball: centre and half sizes."""
CAPSULE = ((-0.175, 0.125, 0.9), 0.012, 0.06)
"""A black capsule along y before the second disc: centre, radius, half length of its cylinder."""


def main() -> None:
    """Render and save the white share of each fine pixel; there are FINE fine pixels along a pixel's edge."""
    fine = by_mujoco() if sys.argv[1] == "mujoco" else by_pyrender()
    np.save(sys.argv[2], fine)


def turn_to(normal: tuple[float, float, float]) -> Array:
    """Return a rotation whose third column is ``normal``."""
    n = np.array(normal) / np.linalg.norm(normal)
    one = np.cross([0.3, 1.0, 0.2], n)
    one /= np.linalg.norm(one)
    return np.column_stack([one, np.cross(n, one), n])


def by_mujoco() -> Array:
    """MuJoCo's renderer: smooth shapes cut into 512 slices, 16 samples a fine pixel."""
    import mujoco
    from scipy.spatial.transform import Rotation

    spec = mujoco.MjSpec()
    spec.visual.quality.numslices = spec.visual.quality.numstacks = 512
    spec.visual.quality.offsamples = 16
    spec.visual.global_.offwidth, spec.visual.global_.offheight = WIDTH * FINE, HEIGHT * FINE
    spec.visual.global_.fovy = float(np.rad2deg(2 * np.arctan(HEIGHT / 2 / FOCAL_PX)))
    spec.visual.headlight.active = 0
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 10.0
    spec.stat.extent = 1.0
    spec.add_material(name="white", emission=1.0, rgba=[1, 1, 1, 1])
    spec.add_material(name="black", emission=0.0, rgba=[0, 0, 0, 1])
    body, kinds = spec.worldbody, mujoco.mjtGeom
    for centre, radius in BALLS:
        body.add_geom(type=kinds.mjGEOM_SPHERE, size=[radius, 0, 0], pos=centre, material="white")
    for centre, normal, radius in DISCS:
        quat = Rotation.from_matrix(turn_to(normal)).as_quat(scalar_first=True)
        body.add_geom(type=kinds.mjGEOM_CYLINDER, size=[radius, 1e-6, 0], pos=centre, quat=quat, material="white")
    body.add_geom(type=kinds.mjGEOM_BOX, size=BOX[1], pos=BOX[0], material="black")
    upright = Rotation.from_euler("x", 90, degrees=True).as_quat(scalar_first=True)
    body.add_geom(type=kinds.mjGEOM_CAPSULE, size=[*CAPSULE[1:], 0], pos=CAPSULE[0], quat=upright, material="black")
    body.add_camera(name="eye", pos=[0, 0, 0], quat=[0, 1, 0, 0], fovy=spec.visual.global_.fovy)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, HEIGHT * FINE, WIDTH * FINE) as renderer:
        renderer.update_scene(data, "eye")
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            renderer.scene.flags[flag] = 0
        return np.asarray(renderer.render()[:, :, 0] / 255.0)


def by_pyrender() -> Array:
    """pyrender, flat shading: spheres of 82 thousand faces, discs of 1024 corners, 4 samples a fine pixel."""
    import pyrender
    import trimesh

    scene = pyrender.Scene(bg_color=[0.0, 0.0, 0.0, 1.0], ambient_light=[1.0, 1.0, 1.0])

    def add(shape: Any, grey: float, centre: Any, turn: Array | None = None) -> None:
        pose = np.eye(4)
        pose[:3, 3] = centre
        if turn is not None:
            pose[:3, :3] = turn
        colour = [grey, grey, grey, 1.0]
        material = pyrender.MetallicRoughnessMaterial(baseColorFactor=colour, doubleSided=True)
        scene.add(pyrender.Mesh.from_trimesh(shape, material=material, smooth=False), pose=pose)

    for centre, radius in BALLS:
        add(trimesh.creation.icosphere(subdivisions=6, radius=radius), 1.0, centre)
    for centre, normal, radius in DISCS:
        add(trimesh.creation.cylinder(radius=radius, height=1e-6, sections=1024), 1.0, centre, turn_to(normal))
    add(trimesh.creation.box(extents=2 * np.array(BOX[1])), 0.0, BOX[0])
    along_y = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    rod = trimesh.creation.capsule(height=2 * CAPSULE[2], radius=CAPSULE[1], count=[256, 256])
    rod.apply_translation(-rod.bounds.mean(axis=0))
    add(rod, 0.0, CAPSULE[0], along_y)
    f, centre_x, centre_y = FOCAL_PX * FINE, WIDTH * FINE / 2, HEIGHT * FINE / 2
    camera = pyrender.IntrinsicsCamera(f, f, centre_x, centre_y, znear=0.05, zfar=10.0)
    scene.add(camera, pose=np.diag([1.0, -1.0, -1.0, 1.0]))
    renderer = pyrender.OffscreenRenderer(WIDTH * FINE, HEIGHT * FINE)
    colour, _depth = renderer.render(scene, flags=pyrender.RenderFlags.FLAT)
    renderer.delete()
    return np.asarray(colour[:, :, 0] / 255.0)


def to_pixels(fine: Array, sigma_px: float) -> Array:
    """Return the pixels (H, W) of a fine image after a Gaussian blur; the image's border lies far from any light."""
    rows, columns = fine.shape[0] // FINE, fine.shape[1] // FINE
    blurred = gaussian_filter1d(fine, sigma_px * FINE, axis=0, mode="constant", truncate=6.0)
    binned = blurred.reshape(rows, FINE, -1).mean(axis=1)
    blurred = gaussian_filter1d(binned, sigma_px * FINE, axis=1, mode="constant", truncate=6.0)
    return np.asarray(blurred.reshape(rows, columns, FINE).mean(axis=2))


if __name__ == "__main__":
    main()
