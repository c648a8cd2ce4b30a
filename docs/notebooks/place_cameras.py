# %% [markdown]
# # Place cameras and see the sigma
#
# How exact will points be, before a camera is bought? Noise of an image point and geometry alone give a lower limit:
# errors of calibration, shake and lens come on top (a scenario with `[calibration]` has them).

# %%
import matplotlib.pyplot as plt
import numpy as np

import mosca

SIGMA_PX = 0.05  # of an image coordinate; `detect` states it for each target of an image of yours


def look_at(position, aim):
    """Return a camera's pose that looks from `position` at `aim` [m], its x axis level."""
    z = (aim - position) / np.linalg.norm(aim - position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return mosca.Pose(np.column_stack([x, np.cross(z, x), z]), position)


def ring(count, radius_m=4.0, height_m=2.4):
    """Return a rig of `count` cameras on a circle, all aimed 1 m above its centre."""
    lens = mosca.OpenCVLens(fx_px=900, fy_px=900, cx_px=639.5, cy_px=511.5)
    azimuths = 2 * np.pi * np.arange(count) / count
    places = [np.array([radius_m * np.cos(a), radius_m * np.sin(a), height_m]) for a in azimuths]
    aim = np.array([0.0, 0.0, 1.0])
    return mosca.Rig(
        tuple(mosca.Camera(f"cam{k + 1}", 1280, 1024, lens, look_at(p, aim)) for k, p in enumerate(places))
    )


# %% [markdown]
# Points on a level grid are projected into every camera; what lies outside an image is not seen. `triangulate` states
# the covariance of each point.

# %%
steps = np.linspace(-2.0, 2.0, 41)
grid = np.array([(x, y, 1.0) for y in steps for x in steps])


def sigma_mm(rig):
    """Return the 3D standard deviation (n,) [mm] of the grid's points, NaN where fewer than two cameras see them."""
    pixels = {}
    for camera in rig.cameras:
        xy = mosca.project(camera, grid)
        inside = ((xy >= 0) & (xy < [camera.width, camera.height])).all(axis=1)
        pixels[camera.name] = np.where(inside[:, None], xy, np.nan)
    covariance = mosca.triangulate(rig, pixels, SIGMA_PX).covariance
    return 1e3 * np.sqrt(np.trace(covariance, axis1=1, axis2=2))


# %%
figure, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
typical = {}
for axis, count in zip(axes, (3, 4, 8), strict=True):
    sigma = sigma_mm(ring(count))
    typical[count] = np.nanmedian(sigma)
    shown = axis.pcolormesh(steps, steps, sigma.reshape(41, 41), vmin=0, vmax=0.6)
    axis.set(title=f"{count} cameras: {typical[count]:.2f} mm", xlabel="x [m]", aspect="equal")
figure.colorbar(shown, ax=axes, label="standard deviation [mm]")
figure.savefig("sigma.png")
print({count: f"{sigma:.3f} mm" for count, sigma in typical.items()})

# %% [markdown]
# Change `height_m`, the aim or the number, and look where the map has holes: fewer than two cameras see those places.
