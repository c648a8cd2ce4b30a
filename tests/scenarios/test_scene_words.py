"""From a scenario's words to things to calibrate with, and to markers that shine in their own way."""

import numpy as np
import pytest

from mosca.errors import InputError
from scenarios.build.scene import build_scene
from scenarios.spec.scenario import load_scenario

BASE = """
title = "x"
[working_space]
size_m = [1.0, 1.0, 1.0]
[capture]
duration_s = 0.1
[scene]
kind = "{kind}"
{scene}
[limits]
completeness = 0.9
"""


def build(tmp_path, kind, scene="", more=""):
    path = tmp_path / "s.toml"
    path.write_text(BASE.format(kind=kind, scene=scene) + more)
    return build_scene(load_scenario(path), tmp_path)


@pytest.mark.parametrize(
    ("kind", "scene", "names"),
    [
        ("field", "markers = 8", 8),
        ("field", 'markers = 8\nlayout = "corner"\nturn_deg_per_s = 20.0', 8),
        ("board", "", ["board"]),
        ("wand", "", ["wand/1", "wand/2", "wand/3"]),
        ("scale_bar", "", ["code/000", "code/001"]),
        ("l_frame", "azimuth_deg = 30.0", ["l_frame/origin", "l_frame/x1", "l_frame/x2", "l_frame/y"]),
        ("light", "", ["light"]),
    ],
)
def test_each_kind_has_its_markers_inside_the_box(tmp_path, kind, scene, names):
    made = build(tmp_path, kind, scene)
    assert len(made.marker_names) == names if isinstance(names, int) else list(made.marker_names) == names
    places = made.sampler().at(0.05).geom_xyz[list(made.marker_geoms)]
    assert (np.abs(places) <= 0.5).all()


def test_a_target_file_is_read_beside_the_scenario(tmp_path):
    (tmp_path / "two.target").write_text('kind = "wand"\nalong_m = [0.0, 0.3]\ndiameter_m = 0.02\n')
    made = build(tmp_path, "wand", 'target = "two.target"')
    first, last = made.sampler().at(0.0).geom_xyz[list(made.marker_geoms)]
    assert np.linalg.norm(last - first) == pytest.approx(0.3)


def test_a_target_file_of_another_kind_is_refused(tmp_path):
    (tmp_path / "two.target").write_text('kind = "wand"\nalong_m = [0.0, 0.3]\ndiameter_m = 0.02\n')
    for kind in ("board", "scale_bar", "l_frame", "field"):
        with pytest.raises(InputError, match=r"two\.target"):
            build(tmp_path, kind, 'target = "two.target"')


CLOUD = "markers = 5\nmarker_diameter_m = 0.02"


def test_a_glow_changes_only_what_it_says(tmp_path):
    made = build(tmp_path, "wand", "", "[glow]\nhalf_deg = 70.0\n")
    assert {(g.kind, g.half_deg, g.strength) for g in made.glows.values()} == {("retro", 70.0, 1.0)}


def test_lamps_blink_unlike_numbers_in_the_glow_that_is_said(tmp_path):
    made = build(tmp_path, "cloud", CLOUD, "[glow]\nhalf_deg = 80.0\nstrength = 2.0\n[lamps]\nframes_per_bit = 2\n")
    blinks = [made.glows[name].blink for name in made.marker_names]
    assert all(blink is not None and blink.bit_s == pytest.approx(0.02) for blink in blinks)
    assert len({blink.bits for blink in blinks if blink is not None}) == 5
    assert {(g.kind, g.half_deg, g.strength) for g in made.glows.values()} == {("lamp", 80.0, 2.0)}


def test_some_markers_may_be_lamps(tmp_path):
    made = build(tmp_path, "cloud", CLOUD, '[glow]\nkind = "retro"\n[lamps]\nnames = ["P2"]\n')
    assert [made.glows[name].kind for name in made.marker_names] == ["retro", "lamp", "retro", "retro", "retro"]


@pytest.mark.parametrize(
    ("more", "parts"),
    [
        ('[lamps]\nnames = ["P9"]\n', ["P9", "P1"]),
        ('[glow]\nkind = "paper"\n[lamps]\n', ["paper", "lamps"]),
        ("[glow]\nshade_world = [0.0, 0.0, 0.0]\n", ["shade_world", "direction"]),
        ("[glow]\nhalf_deg = 90.0\n", ["half_deg", "90"]),
    ],
)
def test_light_that_cannot_be(tmp_path, more, parts):
    with pytest.raises(InputError) as caught:
        build(tmp_path, "cloud", CLOUD, more)
    assert "\n" not in str(caught.value)
    for part in parts:
        assert part in str(caught.value)
