"""Files of subjects and models: kept to the last bit, and refused in one line where they are something else."""

import dataclasses
from collections.abc import Mapping

import mujoco
import numpy as np
import pytest
from skeleton_takes import legs_mjcf, made_subject

from mosca.data.files.npz import write_npz_file
from mosca.errors import InputError
from mosca.formats.bodies.mjcf_writer import write_mjcf
from mosca.formats.bodies.subject_file import read_subject, write_subject
from mosca.skeleton.joints import SegmentAxes
from mosca.skeleton.mjcf import compiled
from mosca.skeleton.model import HUMAN, read_skeleton_model


def bits(value):
    """Return all that a dataclass holds, as nested plain values with the bytes of its arrays."""
    if dataclasses.is_dataclass(value):
        return {field.name: bits(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: bits(one) for key, one in value.items()}
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return value


def arrays_of(path):
    with np.load(path) as file:
        return {name: file[name] for name in file.files if name != "sha256"}


@pytest.fixture(scope="module")
def subject():
    return made_subject()


def test_a_subject_comes_back_to_the_bit(tmp_path, subject):
    write_subject(subject, tmp_path / "s.npz")
    back = read_subject(tmp_path / "s.npz")
    assert bits(back) == bits(subject)
    other = dataclasses.replace(subject, posture=np.nextafter(subject.posture, 1.0))
    assert bits(other) != bits(subject)  # control
    for name in ("parameters", "covariance", "q"):
        assert not getattr(back, name).flags.writeable


def test_a_subject_without_axes_comes_back(tmp_path, subject):
    bare = dataclasses.replace(subject, axes=SegmentAxes({}, {}))
    write_subject(bare, tmp_path / "s.npz")
    assert bits(read_subject(tmp_path / "s.npz")) == bits(bare)


def changed(arrays, name, change):
    return arrays | {name: change(arrays[name])}


def planted(values, place, number):
    copy = np.array(values)
    copy[place] = number
    return copy


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda a: {k: v for k, v in a.items() if k != "posture"}, "posture"),
        (lambda a: a | {"more": np.zeros(3)}, "an array 'more' is not known"),
        (lambda a: changed(a, "q", lambda v: v[:-1]), "q: shape"),
        (lambda a: changed(a, "q", lambda v: planted(v, 4, 2.0)), "a quaternion whose norm is not 1"),
        (lambda a: changed(a, "parameters", lambda v: v[3:]), "parameters: shape"),
        (lambda a: changed(a, "parameters", lambda v: planted(v, 0, np.nan)), "parameters holds a number that"),
        (lambda a: changed(a, "parameters", lambda v: v.astype(np.float32)), "parameters holds float32"),
        (lambda a: changed(a, "covariance", lambda v: planted(v, (0, 1), 1.0)), "covariance is not symmetric"),
        (lambda a: changed(a, "covariance", lambda v: v - 1e-3 * np.eye(len(v))), "covariance is not symmetric"),
        (lambda a: changed(a, "covariance", lambda v: np.ones_like(v) + planted(np.zeros_like(v), (0, 0), -0.5)),
         "Matrix is not positive definite"),
        (lambda a: changed(a, "skin_m", lambda v: -v), "skin_m holds a number below 0"),
        (lambda a: changed(a, "size", lambda v: 1000.0 * v), "no fit of a person"),
        (lambda a: changed(a, "frames", lambda v: np.array(2.5)), "frames is float64 of shape (); one int is"),
        (lambda a: changed(a, "model.rotation_sigma", np.zeros_like), "model.rotation_sigma holds"),
        (lambda a: changed(a, "model.labels", lambda v: v[::-1]), "model.labels are not sites"),
        (lambda a: changed(a, "model.joints", lambda v: v[::-1]), "model.joints are not those"),
        (lambda a: changed(a, "model.labels", lambda v: np.arange(len(v))), "a list of names is wanted"),
        (lambda a: changed(a, "axes.axes.values", lambda v: 2 * v), "are no rotation"),
        (lambda a: changed(a, "axes.axes.keys", lambda v: np.array(["pelvis", "tail"])), "axes are not of bodies"),
        (lambda a: changed(a, "axes.slopes.values", lambda v: v[:, :, 1:]), "axes of"),
        (lambda a: changed(a, "axes.slopes.values", lambda v: v[1:]), "2 names and values of shape"),
        (lambda a: changed(a, "model.mjcf", lambda v: np.array(str(v).replace("<worldbody>", "<worldbody>"
         '<include file="/etc/passwd"/>'))), "<include> stands in it"),
        (lambda a: changed(a, "model.mjcf", lambda v: np.array("<mujoco/>")), "two or more bodies"),
    ],
)  # fmt: skip
def test_other_arrays_are_refused_in_one_line(tmp_path, subject, change, told):
    write_subject(subject, tmp_path / "s.npz")
    write_npz_file(tmp_path / "t.npz", change(arrays_of(tmp_path / "s.npz")))
    with pytest.raises(InputError) as error:
        read_subject(tmp_path / "t.npz")
    assert told in str(error.value)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(f"{tmp_path / 't.npz'}: holds no skeleton subject: ")


def test_a_changed_number_is_seen_by_its_checksum(tmp_path, subject):
    write_subject(subject, tmp_path / "s.npz")
    with np.load(tmp_path / "s.npz") as file:
        arrays = {name: file[name] for name in file.files}
    np.savez(tmp_path / "s.npz", **(arrays | {"posture": arrays["posture"] + 1e-3}))
    with pytest.raises(InputError, match="damaged: its arrays are not those of its checksum"):
        read_subject(tmp_path / "s.npz")


def test_a_subject_is_an_npz(tmp_path, subject):
    with pytest.raises(InputError, match=r"suffix '.xml' given; a subject is a .npz file"):
        write_subject(subject, tmp_path / "s.xml")
    assert list(tmp_path.iterdir()) == []


LEG = legs_mjcf()
DEEP = "<body>" * 70 + "</body>" * 70


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("<worldbody>", '<include file="x.xml"/><worldbody>', "<include> stands in it"),
        ("<worldbody>", '<asset><mesh name="m" file="x.stl"/></asset><worldbody>', "<asset> stands in it"),
        ("<worldbody>", '<extension><plugin plugin="p"/></extension><worldbody>', "<extension> stands in it"),
        ("<worldbody>", '<worldbody><replicate count="1000000000"><site/></replicate>', "<replicate> stands in it"),
        ("<worldbody>", f"<worldbody>{DEEP}", "more than 64 deep"),
        ("<worldbody>", "<worldbody>" + "<site/>" * 200_000, "characters, 1048576 are read at most"),
        ("<mujoco", "<!DOCTYPE a [<!ENTITY b SYSTEM 'file:///etc/passwd'>]><mujoco", "<!DOCTYPE a> stands in it"),
        ('nuser_site="3"', 'nuser_site="3" memory="900G"', '<size nuser_site="3"/> is the one size'),
        ('nuser_site="3"', 'nuser_site="900000000"', '<size nuser_site="3"/> is the one size'),
        ('type="free"', 'type="ball"', "a free joint for the root"),
        ('name="l_hip" type="ball"', 'name="l_hip" type="hinge"', "ball joints for all bodies below it"),
        (
            'name="l_hip" type="ball"',
            'name="l_hip" type="ball" pos="0 0 1"',
            "joint 'l_hip' is off its body's origin",
        ),
        ('<joint name="l_hip" type="ball" />', "", "one joint each"),
        ('name="l_thigh" pos="0 0 -0.086"', 'name="l_thigh" pos="0 0 -86"', None),
        ('name="l_thigh" pos="0 0 -0.086"', 'name="l_thigh" pos="0 0 -860"', "lengths are in m"),
        ('name="l_thigh" pos="0 0 -0.086"', 'name="l_thigh" pos="0 0 -1e-200"', "lengths are in m"),
        ('name="l_thigh" pos="0 0 -0.086"', 'name="l_thigh" pos="0 nan 0"', "XML contains a 'NaN'"),
        ('name="LASI"', "", "site 0 has no name"),
        ('rotation_sigma_deg/l_hip" data="20 20 40"', 'rotation_sigma_deg/l_hip" data="20 0 40"', "three numbers"),
        ('rotation_sigma_deg/l_hip" data="20 20 40"', 'rotation_sigma_deg/l_hip" data="20 20"', "three numbers"),
        ("rotation_sigma_deg/l_hip", "rotation_sigma_deg/l_hop", "'rotation_sigma_deg/l_hop' names no ball joint"),
        ("midpoint/l_knee", "midpoint/l_nee", "'midpoint/l_nee' names no ball joint"),
        ('objname="LKNM"', 'objname="LANM"', "its sites are not of the body above the joint"),
        ('objtype="site" objname="LKNM"', 'objtype="body" objname="l_thigh"', "two sites are wanted"),
        ('user="0.015 0.015 0.015"', 'user="0.015 1e-200 0.015"', "user of a site"),
    ],
)
def test_models_that_are_none(old, new, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert old in LEG
    text = LEG.replace(old, new, 1)
    if told is None:  # control: as far as a model may go
        compiled(text, "legs.xml")
        return
    with pytest.raises(InputError) as error:
        compiled(text, "legs.xml")
    assert told in str(error.value)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith("legs.xml: not a skeleton model: ")
    assert list(tmp_path.iterdir()) == []  # MuJoCo by itself writes MUJOCO_LOG.TXT where it warns


def test_the_persons_model_is_one():
    model = read_skeleton_model(HUMAN, ["LASI", "RASI", "LPSI", "RPSI", "LKNE", "RKNE"])
    assert model.labels == ("LASI", "RASI", "LPSI", "RPSI", "LKNE", "RKNE")
    assert len(model.joints) == 20


def test_a_fitted_model_as_mujoco_reads_it(tmp_path, subject):
    few = subject.model
    write_mjcf(subject, tmp_path / "m.xml")
    mj = mujoco.MjModel.from_xml_path(str(tmp_path / "m.xml"))
    for joint in few.joints:
        np.testing.assert_array_equal(
            mj.body_pos[mj.joint(joint).bodyid[0]], subject.parameters[few.joint_rows(joint)]
        )
    for label in few.labels:
        np.testing.assert_array_equal(mj.site(label).pos, subject.parameters[few.marker_rows(label)])
    # it is a model again
    assert read_skeleton_model(tmp_path / "m.xml", few.labels).parameters.tolist() == subject.parameters.tolist()
