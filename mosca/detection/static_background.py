"""Background of each pixel of a camera that stands still, learned from its images where the background is textured.

A grainy floor under lamps does not change, so it is no noise. Its deviation from the planes between cells
(``mosca.detection.local_background``) is learned pixel by pixel as the value on which most images agree, by majority
vote (Boyer and Moore 1991). An image that agrees with the value so far, within the noise, is averaged into it and
adds a vote. An image that does not agree takes a vote away. Where there is no vote, the next image's value takes its
place. Whatever moves over the pixel, bright or dark, leaves no trace unless it stays for half of the time. Detected
targets do not vote, so a target that stands still never becomes background.

A body before the background hides the texture. It is subtracted in proportion to how far the image's
differences between neighbouring pixels follow those of the texture.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel

MOST_VOTES = 16
"""Largest number of votes of a pixel: its value then has 1/16 of a pixel's variance."""
KNOWN = 2
"""Votes from which a pixel's value is used: two images agreed."""
AGREE_SIGMAS = 4.0
"""Standard deviations within which two grey values of one pixel count as the same; 6 in 100,000 differ by more."""
LEAST_DN2 = 0.25
"""Least variance of a difference between images [DN^2]: a median of whole numbers may be 0."""
NOISE_CELL_PX, STRIDE_PX = 64, 3
"""Side of the cells in which the noise between images is measured, and the distance of its samples: 450 in a cell."""
FILL_PX, FILL_SHARE = (5, 9, 17, 33), 0.2
"""Sides of the squares whose known pixels give the unknown ones, the smallest first, and the least share of known
pixels in a square."""
HIDE_PX = 13
"""Side of the squares that are hidden to test how well they are filled: that of a target of 7 px with its margins."""
FOLLOWED = (1 / 3, 2 / 3)
"""Slopes of the image's differences over the texture's up to which nothing of the texture is subtracted, and from
which all of it is: targets cover part of a background that is seen. They are measured in cells of 32 px, smoothed
over their neighbours. Over squares of 64 or 128 px a benchmark's person before a tiled floor misses 22 of 7,765
images, of 33 px 19, of 17 px 29 (with all of the texture subtracted 174). False detections are 1,130 to 1,330, 1,400,
2,070 and 4,520."""
FOLLOW_STRIDE_PX, FOLLOW_SHIFT_PX = 3, 1
"""Distance of the pixels of a row at which the slope is measured, and the shift from row to row, with which no even
pattern of tiles is missed."""
MARGIN_PX = 1
"""Width of the margin of bright pixels that does not vote either; targets have a further margin by their blur."""


@dataclass(frozen=True, eq=False)
class StaticBackground:
    """Background of the pixels of one camera, as far as it is learned."""

    texture: Array
    """(H, W) float32: background less the planes between its cells' levels [DN], where there are votes."""
    votes: Array
    """(H, W) uint8: images that agree with it, up to ``MOST_VOTES``."""
    images: int = 1
    """Number of images that voted."""

    @cached_property
    def known(self) -> Array:
        """Which pixels (H, W) are known."""
        return np.asarray(self.votes >= KNOWN)

    @cached_property
    def usable(self) -> bool:
        """Whether most pixels are known."""
        return bool(2 * np.count_nonzero(self.known) > self.known.size)

    @cached_property
    def behind(self) -> Array:
        """The texture (H, W) float32 [DN]; unknown pixels have the mean of known pixels around, 0 far from any."""
        return filled(self.texture, self.known)

    @cached_property
    def fill_share(self) -> float:
        """Share of the texture's variance that filling leaves at unknown pixels, found by hiding known ones."""
        hidden = np.zeros(self.votes.shape, bool)
        height, width = self.votes.shape
        for y in range(HIDE_PX, height, 3 * HIDE_PX):
            for x in range(HIDE_PX, width, 3 * HIDE_PX):
                hidden[y : y + HIDE_PX, x : x + HIDE_PX] = True
        tried = hidden & self.known
        if not tried.any():
            return 1.0
        off = filled(self.texture, self.known & ~hidden)[tried] - self.texture[tried]
        return float(min(np.median(off**2) / max(np.median(self.texture[tried] ** 2), LEAST_DN2), 1.0))

    def seen_in(self, image: Array, variance: Array) -> Array:
        """Return how much of the texture an image (H, W) shows in each cell (rows, columns) float32, 0 to 1.

        ``variance``: variance of a pixel in each cell [DN^2].
        """
        reach = (AGREE_SIGMAS * np.sqrt(2.0 * variance)).astype(np.float32)
        together, own = (cv2.GaussianBlur(part, (3, 3), 0) for part in follow(image, self.behind, self.known, reach))
        slope = (together + variance) / (own + variance)
        return np.asarray(np.clip((slope - FOLLOWED[0]) / (FOLLOWED[1] - FOLLOWED[0]), 0.0, 1.0), np.float32)

    def plus(self, other: "StaticBackground | None") -> "StaticBackground":
        """Return this background after the vote of one later image, ``other`` from ``one_image``."""
        if other is None or other.texture.shape != self.texture.shape:
            return self if other is None else other
        texture, votes = self.texture.copy(), self.votes.copy()
        height, width = texture.shape
        cells = disagreement(
            texture,
            votes,
            other.texture,
            other.votes,
            max(1, height // NOISE_CELL_PX),
            max(1, width // NOISE_CELL_PX),
        )
        vote(texture, votes, other.texture, other.votes, cv2.resize(cells, (width, height)))
        return StaticBackground(texture, votes, self.images + 1)


def filled(texture: Array, known: Array) -> Array:
    """Return a texture (H, W) with the mean of the ``known`` pixels around at unknown ones; 0 far from any."""
    there, out = known.astype(np.float32), np.where(known, texture, np.float32(0))
    for side in FILL_PX:
        share = cv2.blur(there, (side, side))
        fill = (there == 0) & (share >= FILL_SHARE)
        out[fill] = (cv2.blur(out, (side, side)) / np.maximum(share, np.float32(FILL_SHARE)))[fill]
        there[fill] = 1
    return out


def one_image(image: Array, planes: Array, bright: Array) -> StaticBackground:
    """Return the votes of one image (H, W): one for each pixel that is neither ``bright`` nor near a bright one.

    ``planes``: (H, W) planes between the levels of its background's cells [DN]; ``bright``: (H, W) uint8, 1 for
    targets.
    """
    side = 2 * MARGIN_PX + 1
    return StaticBackground(image - planes, 1 - cv2.dilate(bright, np.ones((side, side), np.uint8)))


@kernel
def disagreement(texture: Array, votes: Array, seen: Array, counted: Array, rows: int, columns: int) -> Array:
    """Return the standard deviation [DN] (rows, columns) of one image, from its differences from known values.

    It is the median of the differences, so that up to half of a cell may have changed.
    """
    height, width = texture.shape
    spread = np.empty((rows, columns), np.float32)
    off = np.empty((height // rows // STRIDE_PX + 2) * (width // columns // STRIDE_PX + 2), np.float32)
    for i in range(rows):
        for j in range(columns):
            n = 0
            for y in range(height * i // rows, height * (i + 1) // rows, STRIDE_PX):
                for x in range(width * j // columns, width * (j + 1) // columns, STRIDE_PX):
                    if votes[y, x] > 0 and counted[y, x] > 0:
                        # the value's own variance is 1 / votes of the image's
                        off[n] = abs(seen[y, x] - texture[y, x]) / np.sqrt(1.0 + 1.0 / votes[y, x])
                        n += 1
            middle = np.median(off[:n]) / 0.6745 if n > 0 else 0.0
            spread[i, j] = np.sqrt(max(middle * middle, LEAST_DN2))
    return spread


@kernel
def vote(texture: Array, votes: Array, seen: Array, counted: Array, spread: Array) -> None:
    """Let one image vote on the values of all pixels (H, W); ``spread``: standard deviation of the images [DN]."""
    height, width = texture.shape
    for y in range(height):
        for x in range(width):
            if counted[y, x] == 0:
                continue
            n = np.float32(votes[y, x])
            off = seen[y, x] - texture[y, x]
            reach = np.float32(AGREE_SIGMAS) * spread[y, x]
            if n == 0.0:
                texture[y, x], votes[y, x] = seen[y, x], 1
            elif off * off * n <= reach * reach * (n + np.float32(1.0)):
                texture[y, x] += off / (n + np.float32(1.0))
                votes[y, x] = min(votes[y, x] + 1, MOST_VOTES)
            else:
                votes[y, x] -= 1


@kernel
def follow(image: Array, texture: Array, known: Array, reach: Array) -> tuple[Array, Array]:
    """Return sums (rows, columns) of image differences times texture differences, and of squares of the latter.

    The differences are those between neighbouring pixels (H, W) that are ``known``. Edges that only the image has are
    left out: those that the texture explains no better than ``reach`` (rows, columns) [DN].
    """
    height, width = image.shape
    rows, columns = reach.shape
    together, own = np.zeros((rows, columns)), np.zeros((rows, columns))
    for y in range(height - 1):
        i = y * rows // height
        for x in range(FOLLOW_SHIFT_PX * y % FOLLOW_STRIDE_PX, width - 1, FOLLOW_STRIDE_PX):
            j = x * columns // width
            if not known[y, x]:
                continue
            for v, u in ((y, x + 1), (y + 1, x)):
                if not known[v, u]:
                    continue
                seen = np.float32(image[v, u]) - np.float32(image[y, x])
                expected = texture[v, u] - texture[y, x]
                if abs(seen) <= reach[i, j] or abs(seen - expected) <= reach[i, j]:
                    together[i, j] += seen * expected
                    own[i, j] += expected * expected
    return together, own


def subtracted(image: Array, behind: Array, full_dn: int) -> Array:
    """Return an image (H, W) less ``behind`` [DN], of its type; pixels saturated at ``full_dn`` stay so."""
    out = np.empty_like(image)
    subtract_rounded(image, behind, full_dn, out)
    return out


@kernel
def subtract_rounded(image: Array, behind: Array, full: int, out: Array) -> None:
    """Write an image (H, W) less ``behind``, rounded, from 0 to ``full``, to ``out``; pixels at ``full`` stay so."""
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            value = np.int32(image[y, x])
            less = min(max(value - np.int32(np.floor(behind[y, x] + np.float32(0.5))), 0), full)
            out[y, x] = value if value >= full else less
