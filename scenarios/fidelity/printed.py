"""Printed figures, limb darkening and shading against their definitions."""

import numpy as np

from mosca.data.arrays import Array
from reports.fidelity import Check, Row
from scenarios.fidelity.measure import about, centroids_apart, pixels_apart
from scenarios.fidelity.twin_adapter import Target, ball, disc, seen_by_twin, turn_to
from scenarios.fidelity.views import small_camera
from twin.scenes.figure import circle, figure, polygon, ring_sector
from witness.image import points_image
from witness.profile import arc, brightness, dense, outline_image, spots
from witness.render import image_centroid
from witness.views import place, tilted_normal

SIZE, SIGMA = (96, 80), 0.6
LENS, WITNESS = small_camera(SIZE, 300.0, (-0.2, 0.06, 5e-4, -4e-4))
CENTRE = np.array([0.01, -0.015, 1.0])
ROLL = np.array([[np.cos(0.4), -np.sin(0.4), 0.0], [np.sin(0.4), np.cos(0.4), 0.0], [0.0, 0.0, 1.0]])
TURN = turn_to(np.array([0.35, -0.25, -0.9])) @ ROLL
CENTROID_PX, PIXEL, PROFILE_PX = 0.001, 0.001, 0.002
Outlines = list[tuple[Array, float]]

DOT, INNER, OUTER = 0.022, 0.05, 0.065
SECTORS = ((0.2, 0.9), (1.3, 2.6), (3.0, 3.3), (4.0, 5.9))
SQUARE, COLUMNS, ROWS, BLACK = 0.025, 5, 4, 0.1


def figures(quick: bool) -> Check:
    """Check circle, coded target and checkerboard, seen obliquely through a distorting lens."""
    rows: list[Row] = []
    drawn = {"circle": disc_of_tape(), "coded target": coded(), "checkerboard": board()}
    for name, (contours, outlines) in drawn.items():
        image = seen_by_twin(LENS, SIZE, [plate(contours)])[0]
        wanted, _light, centroid = outline_image(WITNESS, CENTRE, TURN, outlines, SIGMA, SIZE)
        off = float(np.hypot(*(image_centroid(image) - centroid)))
        rows.append(Row(f"{name}: centroid", off, "px", CENTROID_PX))
        rows.append(Row(f"{name}: pixels, largest", pixels_apart(image, wanted), "of peak", PIXEL))
    contours, outlines = drawn["coded target"]
    wanted = outline_image(WITNESS, CENTRE, TURN, outlines, SIGMA, SIZE)[0]
    halved: Outlines = [(outline[::2], gain) for outline, gain in outlines]
    coarse = outline_image(WITNESS, CENTRE, TURN, halved, SIGMA, SIZE)[0]
    faults = {
        "sectors in the other sense": [circle(0, 0, DOT), *[_sector(-b, -a) for a, b in SECTORS]],
        "one sector 6 degrees too long": [*contours[:-1], _sector(4.0, 6.0)],
    }
    for name, faulty in faults.items():
        off_peak = pixels_apart(seen_by_twin(LENS, SIZE, [plate(faulty)])[0], wanted)
        rows.append(Row(f"fault: {name}: pixels", off_peak, "of peak", PIXEL, control=True))
    return Check(
        "Printed figures",
        "centre of light, and every pixel, of figures printed on a tilted plate",
        "dense polygons of the definition: moments by the shoelace formula, pixels by Green's theorem",
        f"{about(centroids_apart(wanted, coarse), 'px')}, {about(pixels_apart(wanted, coarse), 'of the peak')}",
        tuple(rows),
    )


def profiles(quick: bool) -> Check:
    """Check balls and discs that are not evenly bright: limb darkening and shading together."""
    rows: list[Row] = []
    limb, shade = 0.5, (0.3, -0.2, 0.0)
    own = 0.0
    for diameter in (5.0, 20.0) if quick else (2.0, 5.0, 10.0, 20.0):
        for tilt in (None, 50.0):
            target, normal = profiled(diameter, tilt, limb, shade)
            image = seen_by_twin(LENS, SIZE, [target])[0]
            centre, radius = target.centre_at(0.0), target.radius
            face = spots(WITNESS, centre, radius, normal, 32, 160 if diameter < 20.0 else 320)
            light = face.area * brightness(face, limb, shade)
            centroid = light @ face.xy / light.sum()
            coarse = spots(WITNESS, centre, radius, normal, 24, 120)
            less = coarse.area * brightness(coarse, limb, shade)
            own = max(own, float(np.hypot(*(less @ coarse.xy / less.sum() - centroid))))
            what = f"{diameter:g} px {'ball' if tilt is None else 'disc at 50 deg'}"
            off = float(np.hypot(*(image_centroid(image) - centroid)))
            rows.append(Row(f"{what}: centroid", off, "px", PROFILE_PX))
            if diameter < 20.0:  # for larger ones the witness's spots would have to be denser
                wanted = points_image(face.xy, light, SIGMA, *SIZE)
                rows.append(Row(f"{what}: pixels, largest", pixels_apart(image, wanted), "of peak", 2 * PIXEL))
    true, _normal = profiled(10.0, None, limb, shade)
    flipped, _normal = profiled(10.0, None, limb, (0.3, 0.2, 0.0))
    pair = [seen_by_twin(LENS, SIZE, [what])[0] for what in (true, flipped)]
    rows.append(Row("fault: shading with y flipped", centroids_apart(*pair), "px", PROFILE_PX, control=True))
    return Check(
        "Limb darkening and shading",
        "centre of light, and every pixel, of markers with half the light missing at the rim and one brighter side",
        "points of light in Gauss-Legendre rings, each with the brightness of the law",
        about(own, "px"),
        tuple(rows),
    )


def profiled(
    diameter: float, tilt: float | None, limb: float, shade: tuple[float, float, float]
) -> tuple[Target, Array | None]:
    """Return a marker and its normal (None: a ball)."""
    centre, radius, sight, one, other = place(WITNESS, (45.0, 37.0), diameter, 2.0)
    if tilt is None:
        return ball(centre, radius, limb=limb, shade=shade), None
    normal = tilted_normal(tilt, sight, one, other)
    return disc(centre, normal, radius, limb=limb, shade=shade), normal


def plate(contours: list[Array], centre: Array = CENTRE) -> Target:
    """Return a still target that carries a figure."""
    drawn = figure(contours)
    return Target(lambda t: centre, drawn.radius, lambda t: TURN, False, drawn)


def disc_of_tape() -> tuple[list[Array], Outlines]:
    """Return a circle: contours for the twin, outlines with gains for the witness."""
    return [circle(0, 0, OUTER)], [(arc(OUTER, 0, 2 * np.pi, 2000)[:-1], 1.0)]


def _sector(start: float, end: float) -> Array:
    return ring_sector(0, 0, INNER, OUTER, start, end)


def coded() -> tuple[list[Array], Outlines]:
    """Return the same for a dot with ring sectors."""
    outlines: Outlines = [(arc(DOT, 0, 2 * np.pi)[:-1], 1.0)]
    for start, end in SECTORS:
        outer, inner = arc(OUTER, start, end), arc(INNER, end, start)
        share = np.linspace(0, 1, 80)[1:-1, None]  # straight sides as dense as the arcs
        sides = [a + (b - a) * share for a, b in ((outer[-1], inner[0]), (inner[-1], outer[0]))]
        outlines.append((np.vstack([outer, sides[0], inner, sides[1]]), 1.0))
    return [circle(0, 0, DOT), *[_sector(a, b) for a, b in SECTORS]], outlines


def board() -> tuple[list[Array], Outlines]:
    """Return the same for black squares on a white plate."""
    half = np.array([COLUMNS + 1, ROWS + 1]) / 2 * SQUARE
    paper = np.array([-half, [half[0], -half[1]], half, [-half[0], half[1]]])
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    black = [
        SQUARE * (np.array([i - COLUMNS / 2, j - ROWS / 2]) + unit)
        for i in range(COLUMNS)
        for j in range(ROWS)
        if (i + j) % 2 == 0
    ]
    contours = [polygon(paper), *[polygon(corners, BLACK - 1.0) for corners in black]]
    return contours, [(dense(paper), 1.0), *[(dense(corners), BLACK - 1.0) for corners in black]]
