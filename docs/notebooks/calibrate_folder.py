# %% [markdown]
# # Calibrate from a folder
#
# Images of a test field, a folder for each camera, become a rig with its precision. The images are those of
# `mosca demo lab`; yours go into a folder of the same form.

# %%
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import mosca

if not Path("lab").exists():
    subprocess.run([sys.executable, "-m", "scenarios.cli.main", "demo", "lab", "lab", "--seconds", "1"], check=True)

# %%
calibration = mosca.calibrate("lab/field", "lab/field.toml")
for finding in calibration.findings:
    print(finding.severity, finding.code, "-", finding.message)
print(f"sigma0 {calibration.sigma0:.2f}, {calibration.used.sum()} image points used of {len(calibration.used)}")

# %% [markdown]
# sigma0 near 1 says that residuals are as large as the detection said. A pattern in them would say that the lens
# model lacks something; without one they point everywhere. Arrows are 1,000 times as long as the residuals.

# %%
cameras = calibration.rig.cameras
figure, axes = plt.subplots(1, len(cameras), figsize=(11, 2.6), layout="constrained")
for k, (axis, camera) in enumerate(zip(axes, cameras, strict=True)):
    mine = (calibration.sightings.camera == k) & calibration.used
    x, y = calibration.sightings.xy_px[mine].T
    axis.quiver(x, y, *calibration.residuals_px[mine].T, angles="xy", scale_units="xy", scale=0.001)
    axis.set(title=camera.name, xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal")
figure.savefig("residuals.png")

# %% [markdown]
# How well are the cameras known? The stated standard deviations of their positions, and how far they really are off:
# the lab came from the twin, which knows.

# %%
true = mosca.read_rig("lab/truth/rig.toml")
sigma = dict(zip(calibration.parameters, np.sqrt(np.diag(calibration.covariance)), strict=True))
for camera, other in zip(cameras, true.cameras, strict=True):
    away = np.linalg.norm(camera.world_from_camera.translation - other.world_from_camera.translation)
    stated = np.sqrt(sum(sigma[f"{camera.name}.{axis}_m"] ** 2 for axis in "XYZ"))
    print(f"{camera.name}: {1e3 * away:.2f} mm off, stated {1e3 * stated:.2f} mm")

mosca.write_rig(calibration.rig, "rig.toml")
