"""``mosca self-orient``: a moving camera's poses from a test field in its recording, compared with those of a rig."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mosca.data.files.rig_file import read_rig
from mosca.data.files.target_file import read_target_file
from mosca.data.files.whole_file import check_writable
from mosca.data.frames import Frame
from mosca.data.rig import Camera, Pose, Rig
from mosca.data.targets import TestField
from mosca.diagnostics.light_marker.window import LampWatch, LampWindow, clock_offset
from mosca.errors import InputError
from mosca.formats.bodies.bodies_csv import write_bodies_csv
from mosca.formats.bodies.body_file import read_bodies
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.machines.self_orientation.comparison import GAP_PERIODS, NAMES, Comparison, compare, estimated_lever_arm
from mosca.machines.self_orientation.images import coded_in, coded_settings, target_images
from mosca.machines.self_orientation.lamp import lamp_in_flight
from mosca.machines.self_orientation.registration import Registration, register_field
from mosca.machines.self_orientation.resection import Resected, ResectionSettings, resect_frames
from mosca.machines.self_orientation.rig_side import LeverArm, body_path, camera_by_rig, with_clock
from mosca.machines.self_orientation.shutter import TargetImages
from mosca.recording import open_recording
from mosca.rigid_bodies.tracker import body_poses

Report = Callable[[int, int | None], None]
NO_FIELD_MOTION = Registration(Pose(np.eye(3), np.zeros(3)), np.zeros((6, 6)), 0.0, 0)
"""Registration of a rig whose world is the test field's frame, as after calibration with that field."""


@dataclass(frozen=True, eq=False)
class _Flight:
    """The camera's frames, kept where the lamp in them is needed; its row time [s], and the bits of a pixel."""

    frames: list[Frame]
    row_s: float
    bit_depth: int


@dataclass(frozen=True)
class SelfOrientOptions:
    """The options of ``mosca self-orient``, under their names."""

    recording: Path
    camera: Path
    field: Path
    out: Path | None
    name: str | None
    fps: float | None
    row_time: float | None
    fewest: int
    tracks: Path | None
    body: Path | None
    seat: Path | None
    rig: Path | None
    rig_recording: Path | None
    registration: Path | None
    light: tuple[float, float, float] | None
    light_diameter: float
    offset: float | None

    def run(self, progress: Report) -> list[str]:
        """Resect, compare and write the requested files; return the lines to print."""
        self._check()
        camera, field = self._camera(), self._field()
        seen, flight = self._seen(camera, field, progress)
        row_s = flight.row_s
        settings = ResectionSettings(fewest=self.fewest, row_time_s=row_s)
        try:
            own = resect_frames(seen, camera, field, settings=settings)
        except InputError as error:
            raise InputError(f"{self.recording}: {error}") from None
        lines = described(camera.name, own, len(seen), row_s)
        if self.tracks is not None:
            lines += self._beside_rig(own, camera, field, flight)
        if self.out is not None:
            write_bodies_csv(own.poses(camera.name), self.out)
            lines.append(f"poses in {self.out}")
        return lines

    def _check(self) -> None:
        if self.out is not None:
            if self.out.suffix.lower() != ".csv":
                raise InputError(f"{self.out}: suffix '{self.out.suffix}' given; poses are written as .csv")
            check_writable(self.out)
        if (self.tracks is None) != (self.body is None):
            raise InputError("--tracks and --body belong together: the rig's tracks, and the body with the camera")
        needs_tracks = {
            "--seat": self.seat, "--rig-recording": self.rig_recording, "--registration": self.registration,
            "--offset": self.offset,
        }  # fmt: skip
        for option, given in needs_tracks.items():
            if given is not None and self.tracks is None:
                raise InputError(f"{option} {given}: is of the comparison with a rig; give --tracks and --body too")
        for option, given in (("--rig-recording", self.rig_recording), ("--registration", self.registration)):
            if given is not None and self.rig is None:
                raise InputError(f"{option} {given}: the rig's cameras are wanted; give --rig RIG.toml")
        if (self.rig_recording is None) != (self.light is None):
            raise InputError(
                "--rig-recording and --light belong together: the rig's images, and where the blinking lamp is"
            )
        if self.rig_recording is not None and self.offset is not None:
            raise InputError(f"--offset {self.offset:g} and --rig-recording given; either tells the clocks' offset")

    def _camera(self) -> Camera:
        return _one_of(read_rig(self.camera), self.name, self.camera)

    def _field(self) -> TestField:
        field = read_target_file(self.field)
        if not isinstance(field, TestField):
            raise InputError(
                f'{self.field}: describes a {type(field).__name__}; a test field is wanted (kind = "field")'
            )
        return field

    def _seen(self, camera: Camera, field: TestField, progress: Report) -> tuple[list[TargetImages], _Flight]:
        """Return the images of targets, and the flight's frames where the lamp in them is needed."""
        seen, frames = [], []
        row_ns = 0
        with open_recording(self.recording, Rig((camera,)), self.fps) as source:
            for k, (frame, found) in enumerate(coded_in(source, source.cameras[0], coded_settings(field))):
                seen.append(target_images(frame, found))
                row_ns = max(row_ns, frame.row_time_ns)
                if self.light is not None:
                    frames.append(frame)
                progress(k + 1, None)
            bits = source.cameras[0].bit_depth
        return seen, _Flight(frames, row_ns * 1e-9 if self.row_time is None else self.row_time, bits)

    def _beside_rig(self, own: Resected, camera: Camera, field: TestField, flight: _Flight) -> list[str]:
        assert self.tracks is not None
        assert self.body is not None
        bodies = read_bodies(self.body)
        if len(bodies) > 1:
            names = ", ".join(one.name for one in bodies)
            raise InputError(f"--body {self.body}: defines {names}; a file with the camera's body alone is wanted")
        tracks = read_tracks(self.tracks)
        try:
            body = body_path(body_poses(tracks, bodies), bodies[0].name)
        except InputError as error:
            raise InputError(f"{self.tracks}: {error}") from None
        lines = []
        there = NO_FIELD_MOTION
        if self.registration is not None:
            there = self._registered(field)
            lines.append(
                f"field registered by {there.targets} targets, {1e3 * there.rms_m:.3g} mm rms off their places"
            )
        offset_s, sigma_s = (self.offset or 0.0), 0.0
        if self.light is not None:
            offset_s, sigma_s, told = self._clock(own, camera, there, flight)
            lines.append(told)
        path = replace(own.path, time_ns=own.path.time_ns - round(offset_s * 1e9))
        gap_s = GAP_PERIODS * float(np.median(np.diff(body.time_ns))) * 1e-9
        if self.seat is None:
            carried = camera_by_rig(body, LeverArm(Pose(np.eye(3), np.zeros(3)), np.zeros((6, 6))), there)
            lever = estimated_lever_arm(path, carried, gap_s)
            lines.append(
                "where the camera sits on the body is estimated from these takes: mean differences are then "
                "near zero by themselves, their scatter is not; give --seat to compare the means"
            )
        else:
            seat = _one_of(read_rig(self.seat), self.name, self.seat).world_from_camera
            lever = LeverArm(seat, np.zeros((6, 6)))
        by_rig = with_clock(camera_by_rig(body, lever, there), sigma_s)
        return lines + table_lines(compare(path, by_rig, gap_s))

    def _registered(self, field: TestField) -> Registration:
        assert self.registration is not None
        assert self.rig is not None
        rig = read_rig(self.rig)
        settings = coded_settings(field)
        found = []
        with open_recording(self.registration, rig, self.fps, times_matter=False) as source:
            infos = {info.name: info for info in source.cameras}
            for frame in source:
                found += [one for _, one in coded_in((frame,), infos[frame.camera], settings)]
        try:
            return register_field(rig, found, field)
        except InputError as error:
            raise InputError(f"{self.registration}: {error}") from None

    def _clock(self, own: Resected, camera: Camera, there: Registration, flight: _Flight) -> tuple[float, float, str]:
        """Return the offset of the camera's stamps [s], its standard deviation, and a line that states them."""
        assert self.light is not None
        assert self.rig_recording is not None
        assert self.rig is not None
        rig, place = read_rig(self.rig), np.array(self.light)
        world = there.world_from_field.transform(place[None])[0]
        with open_recording(self.rig_recording, rig, self.fps) as source:
            watch = LampWatch(source, rig, world, self.light_diameter)
            for _ in watch:
                pass
            rig_light = watch.best()
        window, lamp = LampWindow(camera.name, flight.bit_depth), self.light_diameter
        for frame, xy, radius, away in lamp_in_flight(own, camera, flight.frames, place, lamp, flight.row_s):
            window.take(frame, xy, radius, away)
        found = clock_offset(camera.name, rig_light, window.brightness())
        told = (
            f"clocks: stamps of '{camera.name}' are {found.offset_s:+.6f} +- {found.offset_sigma_s:.6f} s ahead of "
            f"the rig's, by {found.edges} edges of the lamp"
        )
        return found.offset_s, found.offset_sigma_s, told


def described(name: str, own: Resected, frames: int, row_s: float) -> list[str]:
    """Return the lines on the result of the resection."""
    sigma = np.sqrt(np.mean(np.diagonal(own.path.total_covariance(), axis1=1, axis2=2), axis=0))
    place, turn = 1e3 * sigma[:3], np.rad2deg(sigma[3:])
    shutter = f"rows {1e6 * row_s:.3g} us apart are taken into account" if row_s else "all rows taken for one instant"
    return [
        f"camera '{name}': a pose in {len(own.path)} of {frames} frames, {own.withheld} withheld; "
        f"{own.targets.mean():.1f} targets each, {np.sqrt(np.mean(own.residual_px**2)):.3g} px rms, "
        f"{own.rejected} images rejected; {shutter}",
        f"standard deviations (images and targets; the lens's own are not known here): X {place[0]:.3g}, "
        f"Y {place[1]:.3g}, Z {place[2]:.3g} mm; about them {turn[0]:.3g}, {turn[1]:.3g}, {turn[2]:.3g} deg; "
        f"sigma0 {own.sigma0:.3g}",
    ]


def table_lines(found: Comparison) -> list[str]:
    """Return the table of differences, own minus rig."""
    scale = np.array([1e3] * 3 + [180 / np.pi] * 3)
    rows = {"mean": found.mean, "its sigma": found.sigma_of_mean, "rms": found.rms}
    heads = [f"{name} {unit}" for name, unit in zip(NAMES, ("mm",) * 3 + ("deg",) * 3, strict=True)]
    lines = [f"own minus rig's, {len(found.difference)} frames, the field's axes:"]
    lines.append("  " + "".ljust(10) + "".join(one.rjust(12) for one in heads))
    lines += [
        "  " + name.ljust(10) + "".join(f"{value:12.4g}" for value in scale * values) for name, values in rows.items()
    ]
    return lines


def _one_of(rig: Rig, name: str | None, path: Path) -> Camera:
    if name is None and len(rig.cameras) == 1:
        return rig.cameras[0]
    if name is None:
        raise InputError(f"{path}: has cameras {', '.join(rig.names)}; name the moving one with --name")
    if name not in rig.names:
        raise InputError(f"--name {name}: {path} has {', '.join(rig.names)}; name one of them")
    return rig.camera(name)
