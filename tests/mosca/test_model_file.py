"""The marker model's file: round trip, and error messages of one line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.bodies.model_file import model_schema, read_model, write_model
from mosca.labelling.assign import label_tracks
from mosca.labelling.marker_model import MarkerModel, learn_model

GOOD = """
kind = "marker-model"
markers = ["A", "B", "C", "D"]
links = [["A", "B", 0.15, 0.004], ["A", "C", 0.2, 0.004], ["B", "C", 0.25, 0.004], ["C", "D", 0.5, 0.1]]
sides = [["A", "B", "C", "D", 0.002]]
[limbs]
head = ["A", "B", "C"]
"""


def body(frames=60, markers=6, seed=2):
    """Labelled tracks of a rigid set of markers that rotates and moves."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.2, 0.2, (markers, 3))
    angle = 0.03 * np.arange(frames)
    turn = np.zeros((frames, 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
    turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
    xyz = places @ turn.transpose(0, 2, 1) + angle[:, None, None]
    frame, track = np.divmod(np.arange(frames * markers), markers)
    n = len(frame)
    return Tracks(
        frame, frame * 10_000_000, track, np.array([f"M {k}" for k in track]), xyz.reshape(-1, 3),
        np.tile(1e-8 * np.eye(3), (n, 1, 1)), np.full(n, 4), np.full(n, 0.05), np.full(n, "measured"),
    )  # fmt: skip


def test_a_learned_model_survives_its_file_to_the_bit(tmp_path):
    for limbs in (None, {"upper part": ("M 0", "M 1", "M 2", "M 3")}):
        model = learn_model(body(), limbs)
        write_model(model, tmp_path / "model.toml")
        again = read_model(tmp_path / "model.toml")
        assert again.names == model.names
        assert dict(again.limbs) == dict(model.limbs)
        for name in ("mean_m", "sigma_m", "quads", "volume_m3"):
            np.testing.assert_array_equal(getattr(again, name), getattr(model, name))


def test_markers_never_seen_together_have_no_link(tmp_path):
    mean = np.array([[0, 0.1, np.nan], [0.1, 0, 0.2], [np.nan, 0.2, 0]])
    sigma = np.where(np.isnan(mean), np.nan, 0.004)
    model = MarkerModel(("a", "b", "c"), mean, sigma, np.empty((0, 4)), np.empty(0))
    write_model(model, tmp_path / "model.toml")
    np.testing.assert_array_equal(read_model(tmp_path / "model.toml").mean_m, mean)


def test_tracks_are_labelled_as_by_the_model_itself(tmp_path):
    known = body()
    write_model(learn_model(known), tmp_path / "model.toml")
    bare = Tracks(**(vars(known) | {"label": np.full(len(known), ""), "track": 5 - known.track}))
    named = label_tracks(bare, read_model(tmp_path / "model.toml"))
    np.testing.assert_array_equal(named.label, known.label)


def test_one_line_a_link_and_the_example_of_the_page(tmp_path):
    (tmp_path / "model.toml").write_text(GOOD)
    model = read_model(tmp_path / "model.toml")
    assert model.mean_m[0, 1] == 0.15
    assert np.isnan(model.mean_m[0, 3])
    write_model(model, tmp_path / "again.toml")
    lines = (tmp_path / "again.toml").read_text().splitlines()
    assert '  ["A", "B", 0.15, 0.004],' in lines
    assert '  ["A", "B", "C", "D", 0.002],' in lines


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"B", "C", "D"]\nlinks', '"B", "C", "A"]\nlinks', "marker 'A' stands twice"),
        ('["C", "D", 0.5', '["C", "E", 0.5', "links: 'E' is not one of markers"),
        ('["C", "D", 0.5', '["C", "C", 0.5', "a marker stands twice"),
        ('["C", "D", 0.5', '["B", "A", 0.5', "links: 'B' and 'A' stand twice"),
        ("0.5, 0.1", "0.5, 0.0", "greater than 0"),
        ("0.5, 0.1", "0.5", "links"),
        ("0.5, 0.1", "nan, 0.1", "finite"),
        ('"D", 0.002', '"D", 0.0', "volume 0"),
        ('head = ["A"', 'head = ["Z"', "limb 'head': 'Z' is not one of markers"),
        ("marker-model", "bodies", "kind"),
        ("[limbs]", "[limb]", "unknown key 'limb'; did you mean 'limbs'?"),
        ("links = [", "links = [1, ", "links[0]"),
    ],
)
def test_what_is_wrong_is_one_line_that_names_the_file(tmp_path, old, new, said):
    assert old in GOOD
    (tmp_path / "model.toml").write_text(GOOD.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        read_model(tmp_path / "model.toml")
    text = str(error.value)
    assert "\n" not in text
    assert "model.toml" in text
    assert said in text


@given(st.binary(max_size=200) | st.text(max_size=100).map(str.encode))
def test_any_bytes_are_a_model_or_an_input_error(tmp_path_factory, data):
    path: Path = tmp_path_factory.mktemp("fuzz") / "model.toml"
    path.write_bytes(GOOD.encode()[: len(data)] + data)
    with pytest.raises(InputError):
        read_model(path)


def test_the_schema_names_the_keys():
    assert {"kind", "markers", "links", "sides", "limbs"} <= set(model_schema()["properties"])
