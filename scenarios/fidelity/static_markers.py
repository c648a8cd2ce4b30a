"""Image positions of still markers, through every kind of lens."""

from dataclasses import replace

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import Lens, OpenCVLens
from reports.fidelity import Check, Row
from scenarios.fidelity.measure import about, rms
from scenarios.fidelity.twin_adapter import EVEN, ball, seen_by_twin
from scenarios.fidelity.views import LENSES, MATRIX, PLACES, TILT_MATRICES, H, W, marker, shifted
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.optics.lens import TwinLens
from witness.render import WitnessLens, area_and_centroid, image_centroid, with_gap
from witness.views import real_lens

RMS_PX, MAX_PX, LENS_PX = 0.001, 0.004, 1e-6
DIAMETERS = (2.0, 3.1, 5.4, 8.0, 14.7, 25.3, 40.0)
TILTS: tuple[float | None, ...] = (None, 0.0, 30.0, 60.0)
REAL = Optics(gap_px=0.25, tilt_deg=(0.05, -0.04), pupil_shift_m=0.001)
"""Terms that no model of the pipeline expresses, as large as in ``model_gap = "stress"`` and larger."""
OUTLINES = "outlines of 2,000 points through OpenCV's lenses (the paper's by fixed-point inversion), shoelace formula"


def still_markers(quick: bool) -> Check:
    """Check centroids of balls and discs through each lens model, in the centre, at an edge and in a corner."""
    offs = {name: _offs(lens, plain, plain, EVEN, quick) for name, (lens, plain) in LENSES.items()}
    together = np.concatenate(list(offs.values()))
    rows = [row for name, found in offs.items() for row in _rows(f"{name} lens", found[:, 3])]
    for number, what in ((0, "place: {}"), (1, "diameter {:g} px"), (2, "tilt {}")):
        for value in dict.fromkeys(together[:, number]):
            chosen = together[together[:, number] == value, 3].astype(float)
            said = ("ball" if value is None else f"{value:g} deg") if number == 2 else value
            rows.append(Row(what.format(said) + ", rms", rms(chosen), "px", RMS_PX))
    return Check(
        "Still markers",
        "centre of light of the twin's noise-free image with the centroid of the marker's outline",
        OUTLINES,
        about(_outline_error(), "px"),
        (*rows, *_faults()),
    )


def real_lenses(quick: bool) -> Check:
    """Check the same through lenses with higher radial orders, a tilted sensor and an entrance-pupil shift."""
    rows: list[Row] = []
    for name, (lens, plain) in LENSES.items():
        gapped = with_gap(plain, REAL.gap_px, W, H, 11 if name == "fisheye" else 9)
        witness = real_lens(gapped, TILT_MATRICES.get(name, MATRIX), REAL.tilt_deg, REAL.pupil_shift_m)
        rows += _rows(f"{name} lens", _offs(lens, witness, plain, REAL, quick)[:, 3])
    lens, plain = LENSES["rational"]
    without = _offs(lens, plain, plain, REAL, True)[:, 3].astype(float)
    return Check(
        "Still markers through real lenses",
        "the same, with terms that no model of the pipeline can express (a higher order, tilt, pupil shift)",
        f"{OUTLINES}; the terms by their definitions",
        about(_outline_error(), "px"),
        (*rows, Row("fault: a witness without these terms, rms", rms(without), "px", RMS_PX, control=True)),
    )


def lens_models(quick: bool) -> Check:
    """Check each lens model's projection over the whole image, and its inverse."""
    rows: list[Row] = []
    grid = np.stack(np.meshgrid(np.linspace(0, W - 1, 41), np.linspace(0, H - 1, 31)), axis=-1).reshape(-1, 2)
    for name, (lens, witness) in LENSES.items():
        twin = TwinLens.of(lens, W, H, EVEN)
        rays = witness.unproject(grid)
        forth = np.abs(twin.pixels(rays) - witness.project(rays)).max()
        seen = twin.directions(grid)
        ahead = seen[:, 2] > 0.01  # OpenCV's fisheye is undefined behind its own plane
        back = np.abs(witness.project(seen[ahead]) - grid[ahead]).max()
        rows.append(Row(f"{name}: direction to pixel", float(forth), "px", LENS_PX))
        rows.append(Row(f"{name}: pixel to direction", float(back), "px", LENS_PX))
    lens, witness = LENSES["rational"]
    assert isinstance(lens, OpenCVLens)
    rays, fault = witness.unproject(grid), replace(lens, p1=-lens.p1)
    flipped = np.abs(TwinLens.of(fault, W, H, EVEN).pixels(rays) - witness.project(rays)).max()
    rows.append(Row("fault: sign of p1 flipped", float(flipped), "px", LENS_PX, control=True))
    return Check(
        "Lens models",
        "pixels and directions of 1,271 places all over the image, largest difference",
        "cv2.projectPoints (rational, thin prism, tilted sensor), cv2.fisheye; the paper's formula by fixed point",
        "rounding, about 1e-12 px",
        tuple(rows),
    )


def _offs(lens: Lens, witness: WitnessLens, plain: WitnessLens, optics: Optics, quick: bool) -> Array:
    """Return rows of position, diameter, tilt and error of the centroid [px]; object array."""
    rows = []
    for place, xy in PLACES.items():
        for number, diameter in enumerate(DIAMETERS[::3] if quick else DIAMETERS):
            for tilt in TILTS[::3] if quick else TILTS:
                nudge = 0.137 * number  # other positions within a pixel
                target, outline = marker(plain, (xy[0] + nudge, xy[1] - nudge / 2), diameter, tilt)
                _area, centroid = area_and_centroid(witness.project(outline))
                image, _seen = seen_by_twin(lens, (W, H), [target], optics)
                rows.append((place, diameter, tilt, float(np.hypot(*(image_centroid(image) - centroid)))))
    return np.array(rows, dtype=object)


def _rows(name: str, off: Array) -> list[Row]:
    far = off.astype(float)
    return [Row(f"{name}, rms", rms(far), "px", RMS_PX), Row(f"{name}, largest", float(far.max()), "px", MAX_PX)]


def _outline_error() -> float:
    """Return the change of the witness's centroid with half of its points [px]."""
    witness = LENSES["rational"][1]
    polygon = witness.project(marker(witness, PLACES["corner"], 40.0, 60.0)[1])
    return float(np.hypot(*(area_and_centroid(polygon)[1] - area_and_centroid(polygon[::2])[1])))


def _faults() -> tuple[Row, ...]:
    """Return the errors of a marker's position with faulty cameras: each must exceed the bar."""
    lens, witness = LENSES["rational"]
    target, outline = marker(witness, PLACES["edge"], 8.0, None)
    _area, centroid = area_and_centroid(witness.project(outline))
    mirrored = ball(target.centre_at(0.0) * np.array([1.0, -1.0, 1.0]), target.radius)
    faults = {
        "half a pixel (GL's pixel origin)": (shifted(lens, 0.5, 0.5), target),
        "y the wrong way up": (lens, mirrored),
        "principal point off by three bars": (shifted(lens, 0.0, 3 * MAX_PX), target),
    }
    return tuple(
        Row(
            f"fault: {name}",
            float(np.hypot(*(image_centroid(seen_by_twin(faulty, (W, H), [what])[0]) - centroid))),
            "px",
            MAX_PX,
            control=True,
        )
        for name, (faulty, what) in faults.items()
    )
