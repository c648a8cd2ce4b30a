"""Time of target detection beside OpenCV's. Run: ``python tests/benchmarks/bench_detect.py``.

656 x 491 images of blurred discs (8 px, SNR 50, photon and read noise), 16 different ones in turn, one thread.
Times are processor time, the best and the median of the rounds, per image. OpenCV's connected components give whole
regions with binary centroids, its blob detector is set to find every disc.
"""

import time
from collections.abc import Callable

import cv2
import numpy as np
from scipy import ndimage

from mosca.detection.detect import detect, detect_set

WIDTH, HEIGHT, DIAMETER, BLUR, CONTRAST, SNR, BLACK = 656, 491, 8.0, 0.7, 200.0, 50.0, 4.0
OVERSAMPLING = 8


def disc_image(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return an image of n discs that lie at least 16 px apart."""
    cells = rng.permutation((HEIGHT // 20 - 1) * (WIDTH // 20 - 1))[:n]
    rows, columns = np.divmod(cells, WIDTH // 20 - 1)
    centres = 20.0 * np.stack([columns + 1, rows + 1], axis=1) + rng.uniform(-2, 2, (n, 2))
    light = np.zeros((HEIGHT, WIDTH))
    window = 17
    place = (np.arange(window * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    for x, y in centres:
        left, top = round(x) - window // 2, round(y) - window // 2
        disc = np.hypot(place[:, None] + top - y, place[None, :] + left - x) < DIAMETER / 2
        fine = ndimage.gaussian_filter(disc.astype(float), BLUR * OVERSAMPLING)
        pixels = fine.reshape(window, OVERSAMPLING, window, OVERSAMPLING).mean(axis=(1, 3))
        light[top : top + window, left : left + window] += CONTRAST * pixels
    gain = CONTRAST / SNR**2
    noisy = BLACK + rng.poisson(light / gain) * gain + rng.normal(0, 0.5, light.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def times_us(work: Callable[[np.ndarray], object], images: list[np.ndarray], rounds: int) -> tuple[float, float]:
    """Return the best and the median time of ``work`` for one image [us]."""
    for image in images:
        work(image)
    taken = []
    for _ in range(rounds):
        start = time.thread_time()
        for image in images:
            work(image)
        taken.append((time.thread_time() - start) / len(images) * 1e6)
    return min(taken), float(np.median(taken))


def blob_detector() -> cv2.SimpleBlobDetector:
    """Return OpenCV's blob detector, set to find the discs at five thresholds."""
    wanted = cv2.SimpleBlobDetector.Params()
    wanted.minThreshold, wanted.maxThreshold, wanted.thresholdStep = 30, 180, 30
    wanted.filterByColor, wanted.blobColor = True, 255
    wanted.filterByArea, wanted.minArea, wanted.maxArea = True, 8, 400
    wanted.filterByCircularity = wanted.filterByInertia = wanted.filterByConvexity = False
    wanted.minDistBetweenBlobs = 3
    return cv2.SimpleBlobDetector.create(wanted)


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    start = time.thread_time()
    detect(np.zeros((16, 16), np.uint8), "left")
    print(f"first call (compiles, or loads what was compiled): {time.thread_time() - start:.1f} s")
    rng = np.random.default_rng(1)
    blobs = blob_detector()
    for n in (50, 200):
        images = [disc_image(rng, n) for _ in range(16)]
        deep = [image.astype(np.uint16) * 16 for image in images]
        assert all(len(detect(image, "left")) == n for image in images)
        rows = {
            "detect, 8 bit": (lambda image: detect(image, "left"), images, 60),
            "detect, 12 bit": (lambda image: detect(image, "left", bit_depth=12), deep, 60),
            "detect_set of 4, 8 bit, an image": (None, images, 60),
            "cv2.connectedComponentsWithStats": (
                lambda image: cv2.connectedComponentsWithStats(cv2.threshold(image, 17, 255, 0)[1]),
                images,
                30,
            ),
            "cv2.SimpleBlobDetector": (blobs.detect, images, 5),
        }
        print(f"\n{n} targets               best us   median us   x detect")
        ours = 0.0
        for name, (work, given, rounds) in rows.items():
            if work is None:
                sets = [given[k : k + 4] for k in range(0, 16, 4)]
                best, median = times_us(lambda four: detect_set(four, ["a", "b", "c", "d"]), sets, rounds)
                best, median = best / 4, median / 4
            else:
                best, median = times_us(work, given, rounds)
            ours = ours or median
            print(f"{name:34s} {best:8.0f} {median:9.0f} {median / ours:9.1f}")
    large = np.tile(disc_image(rng, 200), (6, 8))[:2946, :5248]
    large[HEIGHT:] = np.minimum(large[HEIGHT:], 8)  # 200 targets, and the noise of 16 megapixels
    large[:HEIGHT, WIDTH:] = np.minimum(large[:HEIGHT, WIDTH:], 8)
    frames = [large, np.roll(large, 64, axis=1)]
    best, median = times_us(lambda image: detect(image, "left"), frames, 20)
    read, _ = times_us(np.max, frames, 20)
    print(
        f"\n{large.size / 1e6:.1f} megapixels, {len(detect(large, 'left'))} targets: best {best:.0f} us, median "
        f"{median:.0f} us ({1e6 / best:.0f} a second); reading the memory alone (np.max): {read:.0f} us"
    )


if __name__ == "__main__":
    main()
