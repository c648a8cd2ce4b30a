"""Check of a rig before an experiment, from a few seconds of its own frames.

It reports devices and their settings, differences of settings, the account of the pulses, brightness and sharpness of
the images, the fit of stamps to pulses, and how long the disk lasts. Nothing is recorded.
"""

import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import NormalDist

import numpy as np

from hardware.driver import DeviceReport
from hardware.drivers import open_camera
from hardware.settings import read_hardware
from hardware.source import HardwareSource, OpenCamera, OpenTrigger
from hardware.triggers import open_trigger
from mosca.data.arrays import Array

SECONDS = 2.0
IMAGES_CHECKED = 8
"""Number of images of each camera that are checked for light and focus, spread over the time."""
DARK, SATURATED = 0.3, 2e-3
"""Share of white below which the brightest pixels count as dark; share of all pixels that may be white."""
EDGES, REACH_PX = 200, 6
BLURRED_PX = 1.2
OWN = ("DeviceUserID", "DeviceTemperature")
"""Settings that are individual to each camera."""


@dataclass
class _Samples:
    pulses: set[int] = field(default_factory=set)
    failed: int = 0
    residuals_ns: list[float] = field(default_factory=list)
    images: list[Array] = field(default_factory=list)


def check_rig_live(
    path: Path,
    seconds: float = SECONDS,
    folder: Path = Path(),
    opener: OpenCamera = open_camera,
    trigger_opener: OpenTrigger = open_trigger,
) -> tuple[list[str], bool]:
    """Take frames of the rig's devices for ``seconds``; return the report, and whether each pulse has its frames.

    ``folder``: where recordings are to go. InputError for the file, DeviceError for a device. ``opener`` and
    ``trigger_opener`` are for tests.
    """
    hardware = read_hardware(path)
    rate_hz = hardware.shared.rate_hz
    pulses = max(round(seconds * rate_hz), IMAGES_CHECKED)
    seen: dict[str, _Samples] = defaultdict(_Samples)
    with HardwareSource(hardware, pulses, opener, trigger_opener) as source:
        infos = {info.name: info for info in source.cameras}
        for frame in source:
            one, pulse = seen[frame.camera], round(frame.time_ns * rate_hz / 1e9)
            one.residuals_ns.append(frame.time_ns - pulse * 1e9 / rate_hz)
            if frame.image is None:
                one.failed += 1
                continue
            one.pulses.add(pulse)
            if len(one.images) < IMAGES_CHECKED and pulse >= len(one.images) * pulses // IMAGES_CHECKED:
                one.images.append(frame.image)
        reports, notes = dict(source.reports), list(source.statistics.notes)
        unproven = {name: one.unproven for name, one in source.statistics.cameras.items()}
    lines, whole = [], True
    for name, info in infos.items():
        one, report = seen[name], reports[name]
        lines.append(_device(name, report))
        lost = pulses - len(one.pulses)
        whole = whole and not lost and not unproven[name]
        parts = [f"{len(one.pulses)} of {pulses} pulses at {rate_hz:g} Hz"]
        if unproven[name]:
            parts.append(f"{unproven[name]} frames whose pulses are not certain")
        if one.failed:
            parts.append(f"{one.failed} frames came damaged")
        if len(one.residuals_ns) > 1:
            parts.append(f"stamps {1e-3 * float(np.std(one.residuals_ns)):.1f} us (rms) off the pulses")
        lines.append("  " + ", ".join(parts))
        if lost:
            lines.append(
                "  frames are missing: lower the rate or the window, shorten the exposure, look at cables and at "
                "net.core.rmem_max"
            )
        lines += [f"  {text}" for text in (light(one.images, info.bit_depth), focus(one.images)) if text]
    lines += differing(reports)
    lines += notes
    lines.append("constant delays between cameras do not show in stamps: film a flash (mosca rig check --flash)")
    rate_bytes = sum(info.image_bytes for info in infos.values()) * rate_hz
    free = shutil.disk_usage(folder).free
    lines.append(
        f"disk of {folder.resolve()}: {free / 1e9:.0f} GB free, {rate_bytes / 1e6:.0f} MB/s before packing: "
        f"{free / rate_bytes / 60:.0f} minutes at least"
    )
    return lines, whole


def _device(name: str, report: DeviceReport) -> str:
    firmware = report.settings.get("DeviceFirmwareVersion") or report.settings.get("DeviceVersion")
    parts = [f"{report.model or 'camera'} {report.serial}".strip()]
    if firmware:
        parts.append(f"firmware {firmware}")
    parts.append(f"{report.width} x {report.height} px, {report.bit_depth} bit")
    if report.exposure_ns:
        parts.append(f"exposure {report.exposure_ns / 1e3:g} us")
    return f"camera '{name}': " + ", ".join(parts)


def differing(reports: Mapping[str, DeviceReport]) -> list[str]:
    """Return a line for each setting whose accepted values differ between cameras of one model."""
    models: dict[str, dict[str, Mapping[str, object]]] = defaultdict(dict)
    for name, report in reports.items():
        models[report.model][name] = report.settings
    lines = []
    for cameras in models.values():
        for key in sorted({key for settings in cameras.values() for key in settings} - set(OWN)):
            values = {name: settings.get(key) for name, settings in cameras.items()}
            if len({str(value) for value in values.values()}) > 1:
                lines.append(f"{key} differs: " + ", ".join(f"{name} {value}" for name, value in values.items()))
    return lines


def light(images: Sequence[Array], bit_depth: int) -> str:
    """Return the brightness of images (H, W) in words, with advice; "" without images."""
    if not images:
        return ""
    white = 2**bit_depth - 1
    brightest = float(np.median([np.partition(image.ravel(), -20)[-20] for image in images])) / white
    saturated = float(np.mean([np.mean(image >= white) for image in images]))
    text = f"brightest pixels at {100 * brightest:.0f} % of white"
    if saturated > SATURATED:
        return f"{text}, {100 * saturated:.1f} % of all pixels white: shorten the exposure, lower gain or light"
    if brightest < DARK:
        return f"{text}: dark; more light, a longer exposure, a larger aperture, or nothing bright is in view"
    return text


def focus(images: Sequence[Array]) -> str:
    """Return the sharpness of the steepest edges of images (H, W) in words, with advice; "" where there are none."""
    widths = [width for image in images if (width := edge_width_px(image)) is not None]
    if not widths:
        return "no clear edges to judge the focus by: put markers in view"
    width = float(np.median(widths))
    text = f"edges are blurred by {width:.1f} px (standard deviation)"
    return f"{text}: focus the lens, or the markers move in the exposure" if width > BLURRED_PX else text


def edge_width_px(image: Array) -> float | None:
    """Return the blur of the steepest edges of an image (H, W) as a Gaussian's standard deviation [px].

    A step of height h, blurred by s, rises at most by h (2 Phi(1 / (2 s)) - 1) from one pixel to the next (Phi: the
    normal distribution). None where no edge exceeds the noise.
    """
    grey = image.astype(np.float64)
    step = np.abs(np.diff(grey, axis=1))
    inner = step[:, REACH_PX:-REACH_PX]
    if inner.size < EDGES:
        return None
    noise = float(np.median(inner)) + 1.0
    chosen = np.argpartition(inner.ravel(), -EDGES)[-EDGES:]
    rows, columns = np.unravel_index(chosen, inner.shape)
    columns = columns + REACH_PX
    profiles = grey[rows[:, None], columns[:, None] + np.arange(1 - REACH_PX, REACH_PX + 1)]
    heights = profiles.max(axis=1) - profiles.min(axis=1)
    steep = step[rows, columns]
    clear = heights > 10 * noise
    if clear.sum() < EDGES / 10:
        return None
    share = float(np.quantile(steep[clear] / heights[clear], 0.75))
    return 0.5 / NormalDist().inv_cdf((1 + min(share, 0.999)) / 2)
