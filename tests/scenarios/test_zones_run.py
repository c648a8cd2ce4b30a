"""Zones side by side: each zone's tracks are those that its cameras alone would give."""

from dataclasses import replace

import numpy as np
import pytest

from mosca.camera.projection import project
from mosca.correspondence.match import MatchSettings
from mosca.data.detections import Detections
from mosca.data.frames import FrameSet
from mosca.data.rig import Pose, Rig
from mosca.data.tracks import Samples, table
from mosca.diagnostics.camera_health import Health, HealthSettings
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings, run_seen
from mosca.precompile import _rig
from mosca.stitching.run import Zone, of_zones, run_zones
from mosca.stitching.stitch import stitched
from scenarios.build.calibration_faults import with_fault
from scenarios.run.zones import zones_of
from scenarios.spec.catalog import find
from scenarios.spec.faults import MovedFault
from scenarios.spec.scenario import load_scenario

PULSES, STEP_M = 90, 0.01
SETTINGS = PipelineSettings(match=MatchSettings(judge_sizes=False, camera_sigma_px=0.05))
START = np.array([[-0.3, 0.0, 0.1], [-0.45, 0.1, 0.0], [-0.4, -0.1, -0.1], [-0.5, 0.0, -0.15]])


def rig_at(x, prefix):
    """Three cameras around (x, 0, 0)."""
    moved = []
    for camera in _rig().cameras:
        pose = camera.world_from_camera
        pose = Pose(pose.rotation, pose.translation + [x, 0.0, 0.0])
        moved.append(replace(camera, name=f"{prefix}{camera.name}", world_from_camera=pose))
    return Rig(tuple(moved))


ZONES = (
    Zone("left", rig_at(0.0, "l"), (-0.6, -0.5, -0.5), (0.3, 0.5, 0.5)),
    Zone("right", rig_at(0.5, "r"), (0.1, -0.5, -0.5), (1.2, 0.5, 0.5)),
)


def seen():
    """What all six cameras see of four points that go along x."""
    for pulse in range(PULSES):
        points = START + [STEP_M * pulse, 0.0, 0.0]
        found = {}
        for camera in (c for zone in ZONES for c in zone.rig.cameras):
            xy = project(camera, points)
            inside = ((xy > 0) & (xy < [camera.width, camera.height])).all(axis=1)
            n = int(inside.sum())
            found[camera.name] = Detections(
                camera.name, xy[inside], np.tile(1e-4 * np.eye(2), (n, 1, 1)), np.full(n, 4.0),
                np.full(n, 100.0), np.ones(n),
            )  # fmt: skip
        yield FrameSet(pulse, pulse * 10_000_000), found, 0.001


def alone(zone):
    names = set(zone.rig.names)
    own = ((s, {n: d for n, d in found.items() if n in names}, t) for s, found, t in seen())
    settings = replace(SETTINGS, volume=(zone.low_m, zone.high_m), lookahead=0)
    return table([step.samples for step in run_seen(own, zone.rig, settings)])


def together():
    start = HealthSettings(start_px=SETTINGS.match.camera_sigma_px)
    steps = list(run_zones(seen(), ZONES, SETTINGS, [Health(zone.rig, start) for zone in ZONES]))
    return steps, table([step.samples for step in steps])


def test_each_zone_measures_what_its_cameras_alone_do():
    steps, tracks = together()
    parts = of_zones(tracks, ZONES)
    for zone in ZONES:
        wanted = alone(zone)
        assert len(wanted) > 100
        for name in ("frame", "track", "xyz", "covariance"):
            np.testing.assert_array_equal(getattr(parts[zone.name], name), getattr(wanted, name))
    assert [step.frame_set.pulse for step in steps] == list(range(PULSES))
    for step in steps:
        assert len(step.points.rays) == len(step.points)
        assert step.points.rays.shape[1] == 6
        assert set(step.detections) == {c for zone in ZONES for c in zone.rig.names}
        assert step.seconds["detect"] == pytest.approx(0.001)


def test_stitched_they_are_four_targets_from_end_to_end():
    _, tracks = together()
    result = stitched(of_zones(tracks, ZONES))
    assert len(np.unique(result.tracks.track)) == 4
    assert result.handed_over == 4
    for k in range(4):
        own = result.tracks.select(result.tracks.track == k)
        path = own.xyz - np.array([STEP_M, 0, 0]) * own.frame[:, None]
        assert np.ptp(path, axis=0).max() < 0.01


def test_two_zones_have_no_camera_in_common():
    shared = (ZONES[0], Zone("again", ZONES[0].rig, *(ZONES[1].low_m, ZONES[1].high_m)))
    with pytest.raises(InputError, match="zones 'left' and 'again': both have camera 'lcam1'"):
        next(run_zones(seen(), shared, PipelineSettings(), [Health(zone.rig) for zone in shared]))


def test_a_scenario_names_its_zones():
    path = find("rigs/zones_two")
    spec = load_scenario(path)
    from scenarios.build.cameras import true_rig

    rig = true_rig(spec, path.parent)
    left, right = zones_of(spec, rig)
    assert (left.name, right.name) == ("left", "right")
    assert left.rig.names == ("a1", "a2", "a3", "a4")
    assert right.low_m[0] < left.high_m[0]
    shifted = with_fault(rig, MovedFault(kind="moved_cameras", cameras=("b1",), shift_m=(0.005, 0, 0)))
    for camera in rig.cameras:
        moved = shifted.camera(camera.name).world_from_camera.translation - camera.world_from_camera.translation
        np.testing.assert_allclose(moved, [0.005 * (camera.name == "b1"), 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("pipeline.watch=true", "zones are not watched"),
        ('zone=[{name="a", cameras=["a1", "a2"], center_m=[0, 0, 0], size_m=[1, 1, 1]}]', "two or more zones"),
        ("pipeline.fill_s=0", "greater than 0"),
    ],
)
def test_what_a_scenario_of_zones_cannot_say(override, said):
    with pytest.raises(InputError, match=said):
        load_scenario(find("rigs/zones_two"), (override,))


def test_a_zone_of_an_unknown_camera():
    spec = load_scenario(find("rigs/zones_two"))
    with pytest.raises(InputError, match=r"\[\[zone\]\] name = 'left': no camera 'a1'; the rig has lcam1"):
        zones_of(spec, ZONES[0].rig)


def test_no_samples_are_no_zones_trouble():
    assert all(len(part) == 0 for part in of_zones(table([Samples.none()]), ZONES).values())
