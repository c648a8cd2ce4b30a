"""The README's moving picture: the walking person in four cameras' images, and the points measured from them.

``python docs/site/moving_picture.py`` runs ``subjects/actor`` for two seconds, as ``mosca run`` does (the rig is
calibrated first), and writes ``docs/pictures/actor.webp``: every 5th frame set, at half speed.
"""

import tempfile
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import mosca
from mosca.recording import open_recording
from reports.images import block_maxima
from scenarios import run_scenario
from scenarios.types import RunOptions

OUT = Path(__file__).resolve().parents[1] / "pictures" / "actor.webp"
SECONDS, EVERY, SLOWER = 2.0, 5, 2
SHOWN = "LFHD"
GROUND, LINES, COOL, WARM = "#16181c", "#d0d4da", "#4aa8d8", "#ffa32b"
DISTANCE_M = 10.0
AT_MOST_BYTES = 1_000_000


def record(folder: Path) -> tuple[Any, mosca.Rig, dict[str, list[np.ndarray]]]:
    """Run the scenario; return result, rig and the images of each camera, in the order of the pulses."""
    result = run_scenario(
        "subjects/actor", {"capture.duration_s": SECONDS}, options=RunOptions(workers=2, record_to=folder)
    )
    rig = mosca.read_rig(folder / "rig.toml")
    images: dict[str, list[np.ndarray]] = {name: [] for name in rig.names}
    with open_recording(folder, rig) as source:
        for frame in source:
            if frame.image is not None:
                images[frame.camera].append(frame.image)
    return result, rig, images


def draw(result: Any, rig: mosca.Rig, images: dict[str, list[np.ndarray]], pulse: int) -> Image.Image:
    """Return the picture of one pulse: space on the left, the cameras' images with detections on the right."""
    figure = plt.figure(figsize=(10, 4.6), dpi=84, facecolor=GROUND)
    tracks, truth = result.tracks, result.truth
    points = tracks.xyz[(tracks.frame == pulse) & (tracks.status == "measured")]
    draw_space(figure.add_axes((0.0, 0.06, 0.5, 0.94)), rig, points, truth.xyz[: pulse + 1, truth.names.index(SHOWN)])
    errors = np.linalg.norm(points[:, None] - truth.xyz[pulse], axis=2).min(axis=1)
    words = f"{len(points)} markers, {1e3 * np.sqrt(np.mean(errors**2)):.2f} mm rms from the truth"
    figure.text(0.02, 0.03, words, color=LINES, fontsize=10)
    for k, camera in enumerate(rig.cameras):
        image = images[camera.name][pulse]
        axes = figure.add_axes((0.505 + 0.248 * (k % 2), 0.505 - 0.485 * (k // 2), 0.24, 0.475))
        # a marker is 3 px wide: thinned by the brightest of each block, as on a run's page, it stays
        blocks = block_maxima(image, 2)
        height, width = (2 * size for size in blocks.shape)
        axes.imshow(
            blocks, cmap="gray", vmax=0.6 * image.max(), aspect="auto", extent=(-0.5, width - 0.5, height - 0.5, -0.5)
        )
        x, y = mosca.detect(image, camera.name).xy_px.T
        axes.scatter(x, y, s=40, facecolor="none", edgecolor=WARM, linewidth=0.7)
        axes.text(12, 38, camera.name, color=LINES, fontsize=8)
        axes.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[], facecolor="black")
        axes.spines[:].set_visible(False)
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
    plt.close(figure)
    return Image.fromarray(pixels)


def draw_space(axes: Any, rig: mosca.Rig, points: np.ndarray, path: np.ndarray) -> None:
    """Draw points (n, 3) [m], a marker's path (t, 3) with its rays, cameras and the floor, in perspective."""
    corners = [np.array([[-3, y, 0], [3, y, 0]]) for y in range(-3, 4)]
    for line in corners + [ends[:, [1, 0, 2]] for ends in corners]:
        axes.plot(*seen(line).T, color="#2c3036", linewidth=0.8)
    for camera in rig.cameras:
        pose = camera.world_from_camera
        axes.plot(*seen(np.array([pose.translation, path[-1]])).T, color=COOL, linewidth=0.6)
        mouth = 0.35 * np.array([[-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1]])
        mouth = mouth @ pose.rotation.T + pose.translation
        for k in range(4):
            axes.plot(*seen(np.array([mouth[k - 1], mouth[k], pose.translation])).T, color=LINES, linewidth=0.9)
        x, y = seen(pose.translation[None])[0]
        axes.text(x, y + 0.03, camera.name, color=LINES, fontsize=8, ha="center")
    axes.plot(*seen(path).T, color=COOL, linewidth=1.6)
    axes.scatter(*seen(points).T, color=WARM, s=9, zorder=3)
    axes.set_axis_off()
    axes.set(xlim=(-0.48, 0.48), ylim=(-0.42, 0.42), aspect="equal")


def seen(xyz: np.ndarray) -> np.ndarray:
    """Return world points (n, 3) [m] in a pinhole camera that looks at the person from above: (n, 2), y up."""
    azimuth, elevation = np.radians((-75, 24))
    back = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    turned = (xyz - [0.0, 0.0, 1.1]) @ np.transpose([right, np.cross(back, right), back])
    return turned[:, :2] / (DISTANCE_M - turned[:, 2:])


def main() -> None:
    """Write the picture; AssertionError where it is too large for a README."""
    with tempfile.TemporaryDirectory() as folder:
        result, rig, images = record(Path(folder) / "take")
        frames = [draw(result, rig, images, pulse) for pulse in range(0, len(result.truth.time_ns), EVERY)]
    period_ms = round(SLOWER * 1000 * EVERY * SECONDS / len(result.truth.time_ns))
    frames[0].save(OUT, save_all=True, append_images=frames[1:], duration=period_ms, loop=0, quality=55, method=6)
    assert OUT.stat().st_size <= AT_MOST_BYTES, OUT.stat().st_size


if __name__ == "__main__":
    main()
