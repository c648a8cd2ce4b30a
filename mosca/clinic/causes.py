"""Causes of faults that the clinic looks for: what each means and what to do about it."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class Cause:
    """A cause: ``title`` describes it in a line, ``next_step`` is what to do."""

    title: str
    next_step: str


CAUSES: dict[str, Cause] = {
    "other-resolution": Cause(
        "the lens parameters belong to another resolution, crop or zoom than the images have",
        "calibrate at the size and crop that you record with, or convert the parameters to it",
    ),
    "wrong-lens": Cause(
        "the rig's lens model does not describe the lenses: residuals grow with the distance from the image's centre",
        "calibrate anew with the lens model left open (mosca calibrate without --lens) and points out to the corners",
    ),
    "camera-moved": Cause(
        "one camera no longer stands or looks as it did when it was calibrated",
        "fix its mount, then calibrate it anew (mosca calibrate --known RIG --exterior-only)",
    ),
    "mirrored-pose": Cause(
        "one camera has the mirrored pose of a plane: it stands on the wrong side of the target's normal",
        "calibrate this camera anew with the target tilted by 20 deg and more, or with one that has depth",
    ),
    "mixed-calibrations": Cause(
        "the rig file mixes two calibrations: one group of cameras is displaced as a whole against the others",
        "take all cameras from one session, or join them by targets that cameras of both groups see",
    ),
    "warming": Cause(
        "images of several cameras drift slowly and steadily: lenses or mounts warm up",
        "let cameras run for an hour before calibrating, keep the room's temperature, calibrate warm",
    ),
    "frames-one-off": Cause(
        "one camera's frames are paired with the wrong frames of the others: whole frame periods apart",
        "shift its frame numbers by the stated number, or cut the videos at a common flash",
    ),
    "dropped-unnoticed": Cause(
        "one camera lost frames that nobody counted: from there on its frames are paired too late or too early",
        "record with frame numbers or stamps (mosca capture), or split the take at the stated time",
    ),
    "sync-lost": Cause(
        "one camera exposes at other instants than the others",
        "check trigger cable, trigger mode and clock of the camera; a free-running camera: mosca reconstruct "
        "--continuous",
    ),
    "rolling-shutter": Cause(
        "rows expose one after the other: images err along their motion, in proportion to the row",
        "use a global shutter, a strobe, or slower motion; with row times: mosca reconstruct --continuous",
    ),
    "arrival-stamps": Cause(
        "the stamps are of arrival at the computer, not of exposure",
        "use the cameras' own stamps (device clock), or frame numbers of triggered cameras",
    ),
    "wrong-scale": Cause(
        "all lengths are wrong by one factor: the target's size is not what its file says (a board printed "
        "at 98 %, a tape read wrongly, another unit); images cannot tell these apart",
        "measure the target's real length, write it into the target file, and calibrate anew",
    ),
    "weak-calibration": Cause(
        "rays meet, yet one length changes with its place or direction: the calibration is weak there (low residual, "
        "wrong answer)",
        "calibrate with the target at several depths and tilts all over the volume",
    ),
    "focus-drift": Cause(
        "images of a camera get blurred in the course of the take",
        "lock focus and aperture, let the camera warm up, refocus and calibrate anew",
    ),
    "saturated": Cause(
        "markers are saturated: most of their pixels are white",
        "shorten the exposure, lower gain or light, close the aperture",
    ),
    "reflections": Cause(
        "cameras see reflections or bright spots that are no markers",
        "cover or matt the surface, mask the region, or bound the volume ([volume] in the settings)",
    ),
    "markers-merged": Cause(
        "images of neighbouring markers run into one another",
        "smaller markers, farther apart; a longer lens or more pixels; detection.split_pairs = true",
    ),
    "labels-swapped": Cause(
        "two labels change places within the take",
        "exchange them from the stated frame on (mosca edit), and give the labelling more distinct distances",
    ),
    "bodies-swapped": Cause(
        "two bodies change places within the take",
        "give each body its own arrangement of markers, exchange them from the stated frame on",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Diagnosis:
    """One candidate cause with its evidence.

    ``p_value``: chance of evidence as strong without the fault; ``explained``: share of the rays' misfit beyond
    noise that the cause explains, None for a cause that does not make rays miss; ``score``: smaller is likelier (for
    causes of misfit, deviance with its penalty); ``evidence``: a line each; ``camera``: the camera at fault.
    """

    code: str
    p_value: float
    evidence: tuple[str, ...]
    explained: float | None = None
    score: float = 0.0
    camera: str | None = None
    figures: dict[str, float] = field(default_factory=dict)

    @property
    def cause(self) -> Cause:
        """Title and next step."""
        return CAUSES[self.code]


def merged(found: Iterable[Diagnosis]) -> list[Diagnosis]:
    """Return one diagnosis for each code: the first one, with the evidence of all and the smallest p-value."""
    one_each: dict[str, Diagnosis] = {}
    for one in found:
        first = one_each.get(one.code)
        one_each[one.code] = (
            one
            if first is None
            else replace(first, p_value=min(first.p_value, one.p_value), evidence=(*first.evidence, *one.evidence))
        )
    return list(one_each.values())
