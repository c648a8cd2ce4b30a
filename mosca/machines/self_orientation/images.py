"""Coded targets of a test field in the frames of a camera."""

from collections.abc import Iterable, Iterator
from typing import Literal

from mosca.coded_targets.detect import CodedSettings, find_coded, settings_of
from mosca.data.found_targets import CodedDetections
from mosca.data.frames import CameraInfo, Frame, mid_exposure_ns
from mosca.data.targets import CodedTarget, TestField
from mosca.errors import InputError
from mosca.machines.self_orientation.shutter import TargetImages


def coded_settings(field: TestField, colour: Literal["white", "black", "both"] = "both") -> CodedSettings:
    """Return the settings for detecting the field's coded targets; InputError where it has none."""
    coded = [one.target for one in field.targets if isinstance(one.target, CodedTarget)]
    if not coded:
        raise InputError(
            "the test field has no coded targets, so that its marks cannot be told apart; give them numbers"
        )
    return settings_of(coded, colour)


def coded_in(
    frames: Iterable[Frame], info: CameraInfo, settings: CodedSettings
) -> Iterator[tuple[Frame, CodedDetections]]:
    """Yield the frames of one camera that have an image, with the coded targets in each."""
    for frame in frames:
        if frame.camera == info.name and frame.image is not None:
            yield frame, find_coded(frame.image, info.name, settings, info.bit_depth)


def target_images(frame: Frame, found: CodedDetections) -> TargetImages:
    """Return the targets found in a frame in the form that the resection needs."""
    return TargetImages(frame.index, mid_exposure_ns(frame), found.number, found.xy_px, found.covariance_px2)
