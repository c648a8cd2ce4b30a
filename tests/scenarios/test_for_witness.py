"""Scenario files as scenes of the Mitsuba witness; needs no Mitsuba."""

import numpy as np
import pytest
import trimesh
from tiny_scenario import write_tiny

import mosca
from scenarios.build.cameras import true_rig
from scenarios.build.scene import build_scene
from scenarios.fidelity.for_witness import main, write_witness_scene
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario
from witness.mitsuba.film import markers
from witness.mitsuba.projection import project
from witness.mitsuba.scene_file import read_scene


def written(name, folder, *overrides):
    """Return a scenario, its folder and the witness's scene of it."""
    path = find(name)
    spec = load_scenario(path, overrides)
    write_witness_scene(spec, path.parent, folder / "scene.toml")
    return spec, path.parent, read_scene(folder / "scene.toml")


@pytest.mark.parametrize("name", ["targets/retro_spheres", "targets/flat_retro"])
def test_markers_and_cameras_are_the_scenarios(name, tmp_path):
    spec, folder, scene = written(name, tmp_path, "capture.duration_s=0.05")
    ours, made = build_scene(spec, folder), markers(scene)
    assert made.names == ours.marker_names
    assert scene.frames == 5
    for frame in range(scene.frames):
        state = ours.sampler().at(frame / 100.0 + spec.capture.exposure_s / 2)
        assert np.abs(made.xyz[frame] - state.marker_xyz).max() < 1e-6
        if ours.model.geom_type[ours.marker_geoms[0]] != 2:
            assert np.abs(made.normal[frame] - state.marker_axis).max() < 1e-5
    for camera, other in zip(true_rig(spec, folder).cameras, scene.cameras, strict=True):
        # but for the shear, OpenCV's lens having none: up to 3 px
        plain = mosca.project(camera, made.xyz[0])
        assert np.abs(plain - project(other, made.xyz[0])).max() < 4.0
    alike = load_scenario(find(name), ("cameras.a=0",))
    write_witness_scene(alike.model_copy(update={"capture": spec.capture}), folder, tmp_path / "even.toml")
    for camera, other in zip(
        true_rig(alike, folder).cameras, read_scene(tmp_path / "even.toml").cameras, strict=True
    ):
        assert np.abs(mosca.project(camera, made.xyz[0]) - project(other, made.xyz[0])).max() < 0.02


def test_sensor_and_lens_are_the_scenarios(tmp_path):
    _, _, scene = written(
        write_tiny(tmp_path).as_posix(), tmp_path, "optics.focus_m=2.0", "optics.f_number=2", "errors.bits=10"
    )
    sensor = scene.sensor
    # the default sensor: 20,000 e at the last of 1,023 counts above a black level of 16, a signal of 0.6 of that
    assert sensor.gain_dn_per_e == pytest.approx((1023 - 16) / 20_000)
    assert (sensor.peak_e, sensor.stray_e, sensor.full_well_e) == (12_000.0, 200.0, 20_000.0)
    assert sensor.read_dn * 4 / sensor.gain_dn_per_e == pytest.approx(10.0)
    # 7.5 mm at f/2: an entrance pupil of 3.75 mm
    assert scene.cameras[0].aperture_m == pytest.approx(3.75e-3, rel=0.01)


def test_what_hides_markers_is_a_mesh(tmp_path):
    _, _, scene = written("subjects/actor", tmp_path, "capture.duration_s=0.02")
    with np.load(tmp_path / "scene_mesh.npz") as mesh:
        vertices, faces = mesh["vertices"], mesh["faces"]
    assert faces.max() < vertices.shape[1]
    # markers of 14 mm on a person's skin: half a diameter from the surface, on a base of some millimetres
    assert 1.6 < np.ptp(vertices[0, :, 2]) < 2.0
    corners = vertices[0][faces]
    corners = corners[trimesh.triangles.area(corners) > 1e-9]  # at poles two corners are one
    for place in markers(scene).xyz[0]:
        nearest = trimesh.triangles.closest_point(corners, np.tile(place, (len(corners), 1)))
        assert 0.006 < np.linalg.norm(nearest - place, axis=1).min() < 0.02
    assert len(vertices) == scene.frames == 2


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("targets/test_field", "printed targets"),
        ("light/glare", "surroundings.glare"),
        ("timing/rolling_shutter", "timing.row_time_s"),
        ("targets/blinking_lamps", "[lamps]"),
        ("lenses/fisheye_190", "fisheye"),
    ],
)
def test_what_cannot_be_rendered_is_refused_by_name(name, said, tmp_path, capsys):
    assert main([name, "--out", str(tmp_path / "out"), "--scene-only"]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_samples_that_are_no_power_of_two_are_refused(tmp_path, capsys):
    given = ["targets/retro_spheres", "--out", str(tmp_path / "out"), "--scene-only", "--samples", "1000"]
    assert main(given) == 2
    assert "1000 samples a pixel given; a power of two is wanted" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_tracks_that_end_too_soon_are_refused(tmp_path):
    written("targets/retro_spheres", tmp_path, "capture.duration_s=0.05")
    file = tmp_path / "scene.toml"
    file.write_text(file.read_text().replace("frames = 5", "frames = 9"))
    with pytest.raises(ValueError, match="are wanted"):
        read_scene(file)
