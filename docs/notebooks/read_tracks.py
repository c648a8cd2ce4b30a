# %% [markdown]
# # Read tracks and see an error
#
# Trajectories from a recorded take, each sample with its covariance, and the truth beside them. The take is made by
# `mosca demo lab`; with your own there is no truth, all else stays.

# %%
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import mosca
from mosca.data.truth import read_truth

if not Path("lab").exists():
    subprocess.run([sys.executable, "-m", "scenarios.cli.main", "demo", "lab", "lab", "--seconds", "1"], check=True)

# %% [markdown]
# The true cameras are used here, so that errors are those of the images alone. `mosca.reconstruct` takes any rig
# file, that of `mosca calibrate` as well.

# %%
tracks = mosca.reconstruct("lab/take", "lab/truth/rig.toml")
print(f"{len(np.unique(tracks.track))} tracks, {len(tracks)} samples, {tracks.n_cameras.mean():.1f} cameras a sample")

# %% [markdown]
# The nearest true marker at the same pulse is the one that was measured: markers are 10 cm apart, errors below 1 mm.

# %%
truth = read_truth(Path("lab/truth/truth.npz"))
away = tracks.xyz[:, None] - truth.xyz[tracks.frame]  # (samples, markers, 3) [m]
nearest = np.linalg.norm(away, axis=2).argmin(axis=1)
error = away[np.arange(len(tracks)), nearest]  # (samples, 3) [m]
rms_mm = 1e3 * np.sqrt((error**2).sum(axis=1).mean())
stated_mm = 1e3 * np.sqrt(np.trace(tracks.covariance, axis1=1, axis2=2).mean())
print(f"rms error {rms_mm:.3f} mm, stated {stated_mm:.3f} mm")

# %% [markdown]
# Is the covariance right? The squared error in its units has the mean 3, and 95 % of it lies below 7.81, where it is.

# %%
nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(tracks.covariance), error)
print(f"mean {nees.mean():.2f}, {(nees < 7.81).mean():.1%} inside the 95 % ellipsoid")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
one = tracks.track == tracks.track[0]
left.plot(1e-9 * tracks.time_ns[one], 1e3 * error[one], label=["x", "y", "z"])
left.set(xlabel="time [s]", ylabel="error of one track [mm]")
left.legend()
right.hist(nees, bins=60, range=(0, 20))
right.set(xlabel="squared error over stated covariance", ylabel="samples")
figure.savefig("errors.png")
