"""Accuracy and time of target detection beside its peers', on the same images, in one run.

Run: ``pip install trackpy optv`` and ``python tests/benchmarks/bench_detect_peers.py [--diameter 8] [--images 16]``.

656 x 491 images of 200 discs (blur 0.7 px, SNR 50) with uniform noise, and with photon noise. Each detector is set
as well as we know how: trackpy with the diameter, OpenCV's blob detector at five levels, OpenPTV's
``target_recognition`` with its half pixel taken off. Errors are of an axis, over the Cramer-Rao bound of a disc of
unknown position, brightness, background and size, computed numerically for the actual noise. One thread; times
are processor time, the least of the rounds.
"""

import argparse
import time
from collections.abc import Callable, Mapping

import cv2
import numpy as np
import trackpy
from optv.parameters import ControlParams, TargetParams
from optv.segmentation import target_recognition
from scipy import ndimage
from scipy.spatial import cKDTree

from mosca.detection.detect import NO_STATISTICS, detect, detect_with_statistics
from mosca.detection.settings import DetectionSettings

WIDTH, HEIGHT, BLUR, SNR, BLACK, MARGIN = 656, 491, 0.7, 50.0, 4.0, 16
OVERSAMPLING = 8
SLOW = ("trackpy.locate", "trackpy.locate, no preprocessing")
Images = list[np.ndarray]
Finder = Callable[[np.ndarray], np.ndarray]


def disc(x: float, y: float, diameter: float, side: int) -> np.ndarray:
    """Return the image (side, side), brightness 1, of a blurred disc at (x, y) of its window."""
    fine = (np.arange(side * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    away = np.hypot(fine[:, None] - y, fine[None, :] - x)
    cover = np.clip(0.5 + (diameter / 2 - away) * OVERSAMPLING, 0.0, 1.0)
    blurred = ndimage.gaussian_filter(cover, BLUR * OVERSAMPLING, truncate=6.0)
    return blurred.reshape(side, OVERSAMPLING, side, OVERSAMPLING).mean(axis=(1, 3))


def variance(light: np.ndarray, kind: str, contrast: float) -> np.ndarray:
    """Return the variance of pixels [DN^2] of so much light, without that of rounding."""
    if kind == "uniform":
        return np.full(light.shape, (contrast / SNR) ** 2)
    return 0.25 + light * contrast / SNR**2


def bound_px(diameter: float, kind: str, contrast: float, rng: np.random.Generator) -> float:
    """Return the Cramer-Rao bound [px] of a coordinate, rms over positions within the pixel."""
    side, variances = int(diameter) + 15, []
    for _ in range(12):
        at = np.array([side // 2 + rng.uniform(-0.5, 0.5), side // 2 + rng.uniform(-0.5, 0.5), diameter])
        steps = np.array([0.02, 0.02, 0.05])
        slopes = [
            contrast * (disc(*(at + d), side) - disc(*(at - d), side)) / (2 * step)
            for step, d in zip(steps, np.diag(steps), strict=True)
        ]
        unit = disc(*at, side)
        slope = np.array([s.ravel() for s in (*slopes, unit, np.ones_like(unit))])
        weight = 1 / (variance(contrast * unit, kind, contrast) + 1 / 12).ravel()
        inverse = np.linalg.inv((slope * weight) @ slope.T)
        variances.append((inverse[0, 0] + inverse[1, 1]) / 2)
    return float(np.sqrt(np.mean(variances)))


def made(
    diameter: float, kind: str, contrast: float, count: int, rng: np.random.Generator
) -> tuple[Images, list[np.ndarray]]:
    """Return images of 200 discs, and where those are (200, 2)."""
    side, images, places = int(diameter) + 15, [], []
    pitch = max(20, int(diameter) + 12)
    rows, columns = (HEIGHT - 2 * MARGIN) // pitch, (WIDTH - 2 * MARGIN) // pitch
    for _ in range(count):
        cells = rng.permutation(rows * columns)[:200]
        middle = MARGIN + pitch * (np.stack(np.divmod(cells, columns)[::-1], axis=1) + 0.5)
        centres = middle + rng.uniform(-2, 2, middle.shape)
        light = np.zeros((HEIGHT, WIDTH))
        for x, y in centres:
            left, top = round(x) - side // 2, round(y) - side // 2
            light[top : top + side, left : left + side] += contrast * disc(x - left, y - top, diameter, side)
        noise = rng.normal(size=light.shape) * np.sqrt(variance(light, kind, contrast))
        images.append(np.clip(np.rint(BLACK + light + noise), 0, 255).astype(np.uint8))
        places.append(centres)
    return images, places


def ours(images: Images, settings: DetectionSettings) -> Finder:
    """Return our detector after it has seen the images once, as in a running pipeline."""
    known = NO_STATISTICS
    for image in images:
        known = known.plus(detect_with_statistics([image], ["left"], settings, statistics=known)[1])
    known.priors(("left",))
    return lambda image: detect(image, "left", settings, statistics=known).xy_px


def peers(diameter: float, threshold: int) -> Mapping[str, Finder]:
    """Return the other detectors."""
    odd = 2 * (int(np.ceil(diameter + 2)) // 2) + 1
    wanted = cv2.SimpleBlobDetector.Params()
    wanted.minThreshold, wanted.maxThreshold, wanted.thresholdStep = threshold, 6 * threshold, threshold
    wanted.filterByColor, wanted.blobColor, wanted.minDistBetweenBlobs = True, 255, 3
    wanted.filterByArea, wanted.minArea, wanted.maxArea = True, 4, 4 * diameter**2
    wanted.filterByCircularity = wanted.filterByInertia = wanted.filterByConvexity = False
    blobs = cv2.SimpleBlobDetector.create(wanted)
    target = TargetParams(
        discont=255, gvthresh=[threshold] * 4, pixel_count_bounds=(4, 4000), xsize_bounds=(2, 100),
        ysize_bounds=(2, 100), min_sum_grey=50,
    )  # fmt: skip
    control = ControlParams(1)
    control.set_image_size((WIDTH, HEIGHT))

    def by_openptv(image: np.ndarray) -> np.ndarray:
        return np.array([t.pos() for t in target_recognition(image, target, 0, control)]) - 0.5

    def by_trackpy(image: np.ndarray, preprocess: bool) -> np.ndarray:
        found = trackpy.locate(image, odd, minmass=threshold * 10, preprocess=preprocess, engine="numba")
        return found[["x", "y"]].to_numpy()

    return {
        "OpenPTV target_recognition": by_openptv,
        "trackpy.locate": lambda image: by_trackpy(image, True),
        "trackpy.locate, no preprocessing": lambda image: by_trackpy(image, False),
        "cv2.SimpleBlobDetector": lambda image: np.array([k.pt for k in blobs.detect(image)]),
    }


def least_ms(finders: Mapping[str, Finder], images: Images, rounds: int) -> dict[str, float]:
    """Return each one's least processor time of an image [ms]; interleaved, so that other load disturbs all alike."""
    least = dict.fromkeys(finders, np.inf)
    for turn in range(rounds):
        for image in images:
            for name, find in finders.items():
                if turn > 0 and name in SLOW:
                    continue
                start = time.thread_time()
                find(image)
                least[name] = min(least[name], 1e3 * (time.thread_time() - start))
    return least


def errors_px(find: Finder, images: Images, places: list[np.ndarray]) -> tuple[np.ndarray, int]:
    """Return the errors (n, 2) of the discs that were found, and the number of false detections."""
    errors, false = [], 0
    for image, true in zip(images, places, strict=True):
        found = find(image)
        away, nearest = cKDTree(true).query(found)
        near = away < 1.0
        false += int(np.count_nonzero(~near))
        errors.append(found[near] - true[nearest[near]])
    return np.concatenate(errors), false


def main() -> None:
    """Print the tables."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--diameter", type=float, default=8.0, help="of the discs [px]")
    asked.add_argument("--images", type=int, default=16)
    asked.add_argument("--rounds", type=int, default=5)
    given = asked.parse_args()
    cv2.setNumThreads(1)
    trackpy.quiet()
    rng = np.random.default_rng(1)
    for kind, contrast in (("uniform", 50.0), ("photon", 200.0)):
        images, places = made(given.diameter, kind, contrast, given.images, rng)
        bound = bound_px(given.diameter, kind, contrast, rng)
        threshold = round(BLACK + 6 * max(contrast / SNR if kind == "uniform" else 0.5, 1.0))
        noise = {"read_noise_dn": contrast / SNR, "gain_dn_per_e": 0.0}
        if kind == "photon":
            noise = {"read_noise_dn": 0.5, "gain_dn_per_e": contrast / SNR**2}
        settings = DetectionSettings(thresholds="paper", lowest_dn=threshold, contrast_dn=threshold, **noise)
        finders = {"ours": ours(images, settings), **peers(given.diameter, threshold)}
        print(f"\ndiameter {given.diameter:g} px, {kind} noise, SNR {SNR:g}: Cramer-Rao bound {bound:.4f} px")
        print(f"{'':34s}   rms px  x bound  bias px   found false      ms  x ours")
        taken = least_ms(finders, images, given.rounds)
        for name, find in finders.items():
            off, false = errors_px(find, images, places)
            rms, bias = float(np.sqrt(np.mean(off**2))), float(np.abs(off.mean(axis=0)).max())
            share = len(off) / (200 * len(images))
            print(
                f"{name:34s} {rms:8.4f} {rms / bound:8.3f} {bias:8.4f} {share:7.2%} {false:5d} {taken[name]:7.3f} "
                f"{taken[name] / taken['ours']:7.2f}"
            )


if __name__ == "__main__":
    main()
