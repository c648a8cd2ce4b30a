"""The verbs for rigs and targets as a lab user meets them: recordings in, rig files, pages and single lines out.

The recordings are rendered by the twin with lenses that the pipeline's model can express, so that the rig the images
were made with is what each verb has to find.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import command_line
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.calibration.quality.compare_rigs import compare_rigs
from mosca.calibration.targets.reader import FieldReader
from mosca.data.files.rig_file import read_rig, write_rig
from mosca.data.files.target_text import target_toml
from mosca.data.rig import OpenCVLens, Pose, Rig
from mosca.data.targets import CodedTarget, TestField
from mosca.recording import RecordingWriter, open_recording
from scenarios.build.cameras import true_rig, virtual_cameras
from scenarios.session.scenes import Session, axes_session, bar_session, target_session
from scenarios.spec.scenario import Scenario
from twin.cameras.virtual_camera import VirtualCamera
from twin.source import TwinSource

SIZE = (480, 360)
FIELD = {
    "markers": 60,
    "stands": 4,
    "frames": 3,
    "size_m": (1.1, 1.1, 1.1),
    "shift": 0.3,
    "tilt_deg": 15.0,
    "world_frames": 0,
}
WAND = {"target": "wand", "frames": 100, "size_m": (1.4, 1.4, 1.4)}


def scenario(**calibration):
    return Scenario.model_validate(
        {
            "title": "three small cameras",
            "model_gap": "none",
            "working_space": {"size_m": [1.0, 1.0, 1.0]},
            "scene": {"kind": "cloud", "marker_diameter_m": 0.02},
            "cameras": {
                "count": 3,
                "azimuth_deg": [0, 100, 220],
                "radius_m": 2.0,
                "height_m": [0.5, 0.9, 0.4],
                "c_mm": 5.0,
                "size_px": SIZE,
            },
            "calibration": calibration,
            "limits": {"position_rms": 1.0},
        }
    )


@dataclass(frozen=True)
class Lab:
    """A folder with recordings, target files and ``truth.toml``, the rig that made them."""

    folder: Path
    truth: Rig

    def __truediv__(self, name):
        return self.folder / name


def recorded(folder: Path, spec: Scenario, session: Session, cameras: tuple[VirtualCamera, ...]) -> Session:
    with (
        TwinSource(
            session.scene,
            cameras,
            frame_rate_hz=spec.calibration.rate_hz,
            exposure_s=1e-3,
            pulses=session.pulses,
            seed=3,
        ) as source,
        RecordingWriter(folder, source.cameras) as writer,
    ):
        for frame in source:
            writer.write(frame)
    return session


def ball_file(**tables) -> str:
    lines = [f"{key} = {json.dumps(value)}" for key, value in tables.items() if key != "marker"]
    for name, place in tables.get("marker", {}).items():
        lines += ["[[marker]]", f'name = "{name}"', f"position_m = {json.dumps(place)}"]
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Return a folder with recordings of a field (again after the rig was moved), a wand, an L-frame and a bar."""
    folder = tmp_path_factory.mktemp("lab")
    spec = scenario(**FIELD)
    truth = true_rig(spec, folder)
    cameras = virtual_cameras(spec, truth)
    field = recorded(folder / "field", spec, target_session(spec, spec.calibration), cameras).target
    (folder / "field.toml").write_text(target_toml(field))
    once = scenario(**{**FIELD, "stands": 1, "frames": 4})
    moved = moved_rig(truth)
    recorded(
        folder / "moved",
        once,
        target_session(once, once.calibration),
        tuple(replace(v, camera=c) for v, c in zip(cameras, moved.cameras, strict=True)),
    )
    waved = scenario(**WAND)
    wand = recorded(folder / "wand", waved, target_session(waved, waved.calibration), cameras).target
    (folder / "wand.toml").write_text(
        ball_file(kind="wand", along_m=wand.along_m, diameter_m=wand.diameter_m, sigma_m=wand.sigma_m)
    )
    frame = recorded(folder / "axes", waved, replace(axes_session(waved), pulses=5), cameras).target
    places = dict(zip(frame.names, frame.positions.tolist(), strict=True))
    (folder / "l_frame.toml").write_text(ball_file(kind="l_frame", diameter_m=frame.diameter_m, marker=places))
    bar = recorded(folder / "bar", waved, replace(bar_session(waved), pulses=15), cameras).target
    (folder / "bar.toml").write_text(
        ball_file(
            kind="scale_bar",
            length_m=bar.length_m,
            sigma_m=bar.sigma_m,
            numbers=[0, 1],
            dot_radius_m=bar.ends[0].dot_radius_m,
        )
    )
    write_rig(truth, folder / "truth.toml")
    write_rig(moved, folder / "moved_truth.toml")
    return Lab(folder, truth)


def moved_rig(rig: Rig) -> Rig:
    """Return the rig moved as a whole, and cam2 rotated by 8 px against the others."""
    motion = Pose(Rotation.from_rotvec([0.0, 0.02, 0.05]).as_matrix(), np.array([0.04, -0.03, 0.02]))
    return carried(Rig(tuple(turned(c, 8.0) if c.name == "cam2" else c for c in rig.cameras)), motion)


def carried(rig: Rig, motion: Pose) -> Rig:
    """Return the rig moved as a whole."""
    return Rig(tuple(replace(c, world_from_camera=motion @ c.world_from_camera) for c in rig.cameras))


def turned(camera, px):
    """Return the camera rotated about its y axis so that its image moves by ``px`` in the middle."""
    turn = Rotation.from_rotvec([0.0, np.arctan(px * camera.lens.mx_mm_per_px / camera.lens.c_mm), 0.0])
    pose = camera.world_from_camera
    return replace(camera, world_from_camera=Pose(pose.rotation @ turn.as_matrix(), pose.translation))


def mosca(*args):
    """Run the command line; return exit code, output and error."""
    done = command_line.mosca(*args, cwd=".")
    return done.returncode, done.stdout, done.stderr


def refused(*args):
    """Run a command line that must fail, and return its only line."""
    return command_line.refusal(*args, cwd=".")


@pytest.fixture(scope="module")
def field_rig(lab):
    """Return the rig file of ``mosca calibrate`` from the field's recording, and its output."""
    out = lab / "rig.toml"
    code, told, err = mosca(
        "calibrate", lab / "field", "--target", lab / "field.toml", "--out", out, "--pixel-pitch-mm", "0.0099"
    )
    assert code == 0, err
    return out, told


def rays_px(truth: Rig, found: Rig, align="none") -> list[float]:
    return [one.rms_px for one in compare_rigs(truth, found, align=align).cameras]


def test_a_field_gives_the_rig_that_made_its_images(lab, field_rig):
    out, told = field_rig
    found = read_rig(out)
    # a camera's body shakes by 0.03 px at each of 12 exposures; unaligned: the field's axes are the world's
    assert max(rays_px(lab.truth, found)) < 0.1
    assert compare_rigs(lab.truth, found, align="none").rms_m < 2e-4
    assert {c.lens.mx_mm_per_px for c in found.cameras} == {0.0099}
    assert "scale from the test field's marks" in told
    assert told.count("sigma_x") == 2 * len(found.cameras)
    page = out.with_suffix(".html").read_text()
    assert "cam3" in page
    assert "<html" in page
    record = json.loads(out.with_suffix(".calibration.json").read_text())
    assert [one["name"] for one in record["cameras"]] == list(found.names)
    assert f"{record['image_points']} image points, {record['left_out']} left out" in told
    assert f"{record['cameras'][0]['name']}: sigma_x {record['cameras'][0]['sigma_px'][0]:.3f} px" in told
    assert [f"{one['code']}: {one['message']}" in told for one in record["findings"]] == [True] * len(
        record["findings"]
    )


def test_the_comparison_names_the_camera_that_was_turned_by_a_pixel(lab, field_rig, tmp_path):
    rig = read_rig(field_rig[0])
    write_rig(Rig(tuple(turned(c, 1.0) if c.name == "cam2" else c for c in rig.cameras)), tmp_path / "turned.toml")
    code, out, _ = mosca("rig", "compare", field_rig[0], tmp_path / "turned.toml", "--align", "none")
    assert code == 0
    rows = [line.split() for line in out.splitlines() if line.startswith("cam") and "rays" not in line]
    rms = {row[0]: float(row[1]) for row in rows}
    assert rms["cam1"] == rms["cam3"] == 0.0
    assert rms["cam2"] == pytest.approx(1.0, abs=0.15)  # more towards the corners
    # the same rig carried elsewhere differs in nothing that a rigid motion does not take off
    motion = Pose(Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix(), np.array([1.0, 0.5, -0.2]))
    write_rig(carried(rig, motion), tmp_path / "carried.toml")
    assert max(rays_px(rig, read_rig(tmp_path / "carried.toml"), "rigid")) < 1e-6


def test_exterior_alone_after_the_rig_was_moved(lab, field_rig, tmp_path):
    out = tmp_path / "new.toml"
    code, told, err = mosca(
        "calibrate", lab / "moved", "--target", lab / "field.toml", "--known", field_rig[0], "--exterior-only",
        "--out", out,
    )  # fmt: skip
    assert code == 0, err
    found, before = read_rig(out), read_rig(field_rig[0])
    assert [c.lens for c in found.cameras] == [c.lens for c in before.cameras]
    assert max(rays_px(read_rig(lab / "moved_truth.toml"), found)) < 0.15
    assert min(rays_px(lab.truth, found)) > 5
    # all cameras moved alike, cam2 was also rotated
    warned = [line for line in told.splitlines() if line.startswith("WARNING rig-moved")]
    assert len(warned) == 1
    assert "'cam2'" in warned[0]


def test_wand_and_l_frame(lab, tmp_path):
    out = tmp_path / "rig.toml"
    code, told, err = mosca(
        "calibrate", lab / "wand", "--target", lab / "wand.toml", "--axes", lab / "axes", lab / "l_frame.toml",
        "--lengths", lab / "bar", lab / "bar.toml", "--pixel-pitch-mm", 0.0099, "--out", out,
    )  # fmt: skip
    assert code == 0, err
    assert "wand" in told
    assert out.with_suffix(".html").exists()
    found = compare_rigs(lab.truth, read_rig(out), ((-0.4, -0.4, -0.4), (0.4, 0.4, 0.4)), align="none")
    assert found.rms_m < 1.5e-3, found.lines()


def test_a_wand_with_chosen_lens_parameters_and_detection(lab, tmp_path):
    """What is not named stays 0."""
    given = ("calibrate", lab / "wand", "--target", lab / "wand.toml", "--pixel-pitch-mm", 0.0099)
    out = tmp_path / "rig.toml"
    code, told, err = mosca(
        *given,
        "--free",
        "c_mm,xp_px,yp_px,K1_per_mm2,P1_per_mm,P2_per_mm",
        "--set",
        "detection.false_alarms=0.001",
        "--out",
        out,
    )
    assert code == 0, err
    assert "sigma_x" in told
    for camera in read_rig(out).cameras:
        lens = camera.lens
        assert lens.K1_per_mm2 != 0
        assert lens.P1_per_mm != 0
        assert (lens.K2_per_mm4, lens.K3_per_mm6, lens.a) == (0, 0, 0)
        assert lens.my_mm_per_px == lens.mx_mm_per_px
    found = compare_rigs(lab.truth, read_rig(out), ((-0.4, -0.4, -0.4), (0.4, 0.4, 0.4)), align="rigid")
    assert found.rms_m < 3e-3, found.lines()
    # the control: a size that no ball reaches
    line = refused(*given, "--set", "detection.minimum_size_px=39", "--out", tmp_path / "no.toml")
    assert "show the target" in line


def test_a_refused_calibration_has_a_page_and_no_rig(lab, tmp_path):
    field = read_field(lab / "field.toml")
    out, target = tmp_path / "rig.toml", tmp_path / "mm.toml"
    target.write_text(target_toml(scaled(field, 1000.0)))
    line = refused("calibrate", lab / "field", "--target", target, "--out", out)
    assert "mixed-units" in line
    assert str(out.with_suffix(".html")) in line
    assert not out.exists()
    assert "mixed-units" in out.with_suffix(".html").read_text()


def read_field(path: Path) -> TestField:
    from mosca.data.files.target_file import read_target_file

    field = read_target_file(path)
    assert isinstance(field, TestField)
    return field


def scaled(field: TestField, factor: float) -> TestField:
    return TestField(tuple(replace(one, position=factor * one.position) for one in field.targets), 0.0)


def other_numbers(field: TestField) -> TestField:
    """Return a field of numbers that the recorded one does not have."""
    used = {one.target.number for one in field.targets}
    free = [number for number in range(507) if number not in used]
    return TestField(
        tuple(
            replace(one, name=f"other/{n}", target=CodedTarget.of_dot(n, one.target.dot_radius_m))
            for n, one in zip(free, field.targets, strict=False)
        )
    )


def test_a_wrong_field_is_told_long_before_the_recordings_end(lab, tmp_path, monkeypatch):
    """300 frame sets of one camera that show the lab's field; 60 of them tell that another one was given."""
    looked = []
    monkeypatch.setattr(FieldReader, "read", lambda *given, read=FieldReader.read: looked.append(1) or read(*given))
    with open_recording(lab / "field") as source:
        camera = source.cameras[0]
        frame = next(one for one in source if one.camera == camera.name)
    with RecordingWriter(tmp_path / "long", (camera,)) as writer:
        for k in range(300):
            time_ns = round(k * 1e9 / camera.frame_rate_hz)
            writer.write(replace(frame, index=k, time_ns=time_ns))
    (tmp_path / "other.toml").write_text(target_toml(other_numbers(read_field(lab / "field.toml"))))
    given = ("calibrate", tmp_path / "long", "--target", tmp_path / "other.toml", "--out", tmp_path / "rig.toml")
    assert "0 of 60 frame sets spread over 300 of cam1 show the target; its numbers are " in refused(*given)
    assert len(looked) == 60
    assert list(tmp_path.glob("rig*")) == []


def test_bad_input_is_one_line(lab, tmp_path):
    out, target = tmp_path / "rig.toml", lab / "field.toml"

    def line(*options, recording="field", target=target, out=out):
        return refused("calibrate", lab / recording, "--target", target, "--out", out, *options)

    assert "no such folder" in line(recording="fields")
    assert "ends in .toml" in line(out=tmp_path / "rig.yaml")
    assert "no folder" in line(out=tmp_path / "nowhere/rig.toml")
    assert "'mosca', 'opencv', 'fisheye'" in line("--lens", "brown")
    assert "no such file" in line(target=lab / "fields.toml")
    assert "--known RIG.toml" in line("--exterior-only")
    assert "LFrame is wanted" in line("--axes", lab / "axes", target)
    assert "ScaleBar is wanted" in line("--lengths", lab / "bar", target)
    small = Rig(tuple(replace(c, width=320, height=240) for c in lab.truth.cameras))
    write_rig(small, tmp_path / "small.toml")
    assert "320" in line("--known", tmp_path / "small.toml", "--exterior-only")
    assert "does not calibrate cameras" in line(target=lab / "l_frame.toml")
    (tmp_path / "odd.toml").write_text('kind = "sphere"\n')
    assert "kind = 'sphere'" in line(target=tmp_path / "odd.toml")
    assert "show the target" in line(recording="axes")
    (tmp_path / "other.toml").write_text(target_toml(other_numbers(read_field(target))))
    assert "show the target" in line("--every", 6, target=tmp_path / "other.toml")
    assert "frame set 99: the target" in line("--reference", 99)
    assert "0 to 11 are allowed" in line("--reference", 99)
    assert "lens parameter 'k1' cannot be estimated; allowed: c_mm" in line("--free", "c_mm,k1")
    assert "leave it out" in line("--known", lab / "truth.toml", "--exterior-only", "--free", "c_mm")
    wand = {"target": lab / "wand.toml", "recording": "wand"}
    assert "of a wand's cameras c_mm must be estimated" in line("--free", "xp_px", **wand)
    assert "a number greater than 0" in line("--set", "detection.false_alarms=0", **wand)
    assert "settings of detection.KEY=VALUE alone" in line("--set", "track.gate_m=1", **wand)
    assert "balls alone are detected" in line("--set", "detection.false_alarms=0.1")
    points = tmp_path / "points.toml"
    points.write_text('kind = "points"\nunit = "mm"\nsize_px = [480, 360]\n[[camera]]\nname = "a"\nfile = "a.txt"\n')
    assert "--reference: not with" in line("--reference", 1, target=points)
    assert "--exterior-only: not with" in line("--exterior-only", target=points)
    assert list(tmp_path.glob("rig.*")) == []


def test_a_rig_is_described_camera_by_camera(lab):
    code, out, _ = mosca("rig", "check", lab / "truth.toml")
    lines = out.splitlines()
    assert code == 0
    assert len(lines) == 3 + 3  # cameras and pairs
    # a pinhole of 5 mm over 480 x 360 pixels of 9.9 um: 2 atan(479 * 0.0099 / 10) and 2 atan(359 * 0.0099 / 10)
    assert "sees 51 x 39 deg" in lines[0]
    assert "at (2.000, 0.000, 0.500) m" in lines[0]
    assert "did you mean" in refused("rig", "check", lab / "truht.toml")


@pytest.mark.parametrize(("name", "file"), [("aniposelib", "a.toml"), ("opencv", "cameras"), ("mosca", "b.toml")])
def test_a_rig_goes_to_another_program_and_back(lab, tmp_path, name, file):
    lens = OpenCVLens(505.0, 506.0, 240.0, 178.0, -0.1, 0.02, 1e-4, -2e-4)
    rig = Rig(tuple(replace(c, lens=lens) for c in lab.truth.cameras))
    write_rig(rig, tmp_path / "rig.toml")
    code, out, err = mosca("rig", "convert", tmp_path / "rig.toml", tmp_path / file, "--format", name)
    assert code == 0, err
    assert "3 cameras" in out
    back = tmp_path / "back.toml"
    code, _, err = mosca("rig", "convert", tmp_path / file, back, "--unit", "m", "--size-px", *SIZE)
    assert code == 0, err
    assert max(rays_px(rig, read_rig(back))) < 1e-4


def test_a_target_is_printed(lab, tmp_path):
    small = TestField(read_field(lab / "field.toml").targets[:4])
    (tmp_path / "few.toml").write_text(target_toml(small))
    code, out, err = mosca("target", "sheet", tmp_path / "few.toml", "--out", tmp_path / "few.pdf")
    assert code == 0, err
    sheets = list(tmp_path.glob("few*.pdf"))
    assert sheets
    assert all(sheet.read_bytes().startswith(b"%PDF") for sheet in sheets)
    assert len(out.strip().splitlines()) == len(sheets)
    assert "measure its ruler" in out
    (tmp_path / "points.toml").write_text(
        'kind = "points"\nunit = "mm"\nsize_px = [640, 480]\n[[camera]]\nname = "a"\nfile = "a.txt"\n'
    )
    assert "nothing to print" in refused("target", "sheet", tmp_path / "points.toml", "--out", tmp_path / "p.pdf")


def test_the_schema_of_target_files_knows_every_kind():
    code, out, _ = mosca("schema", "target")
    assert code == 0
    kinds = json.loads(out)["discriminator"]["mapping"]
    assert set(kinds) == {"points", "field", "board", "wand", "light", "l_frame", "scale_bar"}


EXAMPLES = Path(__file__).resolve().parents[2] / "docs/examples"


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("calibration_*.toml")), ids=lambda path: path.stem)
def test_the_documented_target_files_can_be_used(path, tmp_path):
    from mosca.data.files.target_file import read_target_file

    made = read_target_file(path)
    if path.stem == "calibration_field":
        assert isinstance(made, TestField)
        code, _, err = mosca("target", "sheet", path, "--out", tmp_path / "sheet.pdf")
        assert code == 0, err
