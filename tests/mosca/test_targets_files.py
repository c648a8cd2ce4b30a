"""Target files of all kinds: read, written, explained, and never another error than InputError."""

import contextlib
import tomllib

import numpy as np
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mosca.data.boards import Board
from mosca.data.files.target_file import PointsTarget, read_target_file, target_schema
from mosca.data.files.target_tables import TABLES
from mosca.data.files.target_text import target_toml
from mosca.data.targets import BallTarget, CodedTarget, PlacedTarget, RoundTarget, ScaleBar, TestField
from mosca.data.wands import LFrame, SingleLight, Wand
from mosca.errors import InputError

FIELD = """kind = "field"
dot_radius_m = 0.008
sigma_m = 2e-5
[[target]]
number = 17
position_m = [0.1, 0.0, 0.35]
normal = [0.0, 2.0, 0.0]
[[target]]
name = "top"
position_m = [0.1, 0.0, 0.5]
"""
BOARD = """kind = "board"
columns = 9
rows = 6
square_m = 0.04
marker_m = 0.03
dictionary = "DICT_5X5_50"
"""
WAND = 'kind = "wand"\nalong_m = [0, 0.15, 0.5]\ndiameter_m = 0.014\n'
LIGHT = 'kind = "light"\nbetween = ["a", "b"]\napart_m = 1.5\n'
FRAME = """kind = "l_frame"
diameter_m = 0.014
marker = [
  {name = "o", position_m = [0, 0, 0.02]}, {name = "x", position_m = [0.6, 0, 0.02]},
  {name = "y", position_m = [0, 0.4, 0.02]},
]
"""
BAR = 'kind = "scale_bar"\nlength_m = 1.00012\nsigma_m = 5e-6\nnumbers = [3, 4]\ndot_radius_m = 0.008\n'


def read(folder, text):
    path = folder / "target.toml"
    path.write_text(text)
    return read_target_file(path)


def test_a_field(tmp_path):
    field = read(tmp_path, FIELD)
    assert isinstance(field, TestField)
    assert field.names == ("code/017", "top")
    assert field.targets[0].target == CodedTarget(17, 0.008, 0.016, 0.024, 0.064)
    assert field.targets[1].target == RoundTarget(0.008)
    np.testing.assert_array_equal(field.targets[0].normal, [0, 1, 0])
    np.testing.assert_array_equal(field.positions, [[0.1, 0, 0.35], [0.1, 0, 0.5]])
    assert field.sigma_m == 2e-5


def test_a_board_a_wand_a_frame_and_bars(tmp_path):
    assert read(tmp_path, BOARD) == Board(9, 6, 0.04, 0.04, 0.03, "DICT_5X5_50")
    assert read(tmp_path, WAND) == Wand((0.0, 0.15, 0.5), 0.014)
    frame = read(tmp_path, FRAME)
    assert isinstance(frame, LFrame)
    assert frame.names == ("o", "x", "y")
    np.testing.assert_array_equal(frame.positions, [[0, 0, 0.02], [0.6, 0, 0.02], [0, 0.4, 0.02]])
    coded = CodedTarget.of_dot(3, 0.008), CodedTarget.of_dot(4, 0.008)
    assert read(tmp_path, BAR) == ScaleBar(1.00012, 5e-6, coded)
    plain = BAR.replace("numbers = [3, 4]\ndot_radius_m = 0.008", "ball_diameter_m = 0.02")
    assert read(tmp_path, plain) == ScaleBar(1.00012, 5e-6, (BallTarget(0.02), BallTarget(0.02)))
    plain = plain.replace("ball_diameter_m", "round_radius_m")
    assert read(tmp_path, plain) == ScaleBar(1.00012, 5e-6, (RoundTarget(0.02), RoundTarget(0.02)))


def test_measured_points(tmp_path):
    text = 'kind = "points"\nunit = "mm"\nsize_px = [8, 8]\n[[camera]]\nname = "a"\nfile = "a.txt"\n'
    assert isinstance(read(tmp_path, text), PointsTarget)


@pytest.mark.parametrize(
    ("text", "old", "new", "said"),
    [
        (
            FIELD,
            '"field"',
            '"feld"',
            "kind = 'feld' given; allowed: 'points', 'field', 'board', 'wand', 'light', 'l_frame'",
        ),
        (FIELD, "number = 17", "number = 507", "target[0].number"),
        (FIELD, "dot_radius_m", "dot_radius", "unknown key 'dot_radius'; did you mean 'dot_radius_m'?"),
        (FIELD, "0.35]", "3500]", "target[0].position_m[2]': 3500 given"),
        (FIELD, "[0.0, 2.0, 0.0]", "[0, 0, 0]", "key 'target[0]': normal = [0.0, 0.0, 0.0] given"),
        (FIELD, 'name = "top"', "number = 17", "target 'code/017' stands twice"),
        (FIELD, 'name = "top"', 'nam = "top"', "unknown key 'target[1].nam'; did you mean 'name'?"),
        (FIELD, "dot_radius_m = 0.008", "dot_radius_m = 0.008\nplate_m = 0.01", "the ring on the plate"),
        (BOARD, "columns = 9", "columns = 2", "key 'columns': 2 given"),
        (BOARD, "DICT_5X5_50", "DICT_5X5", "dictionary = 'DICT_5X5' given; allowed: "),
        (BOARD, "rows = 6", "", "key 'rows' is missing; (squares from top to bottom) add it"),
        (BOARD, "marker_m = 0.03\n", "", "marker_m and dictionary go together"),
        (WAND, "[0, 0.15, 0.5]", "[0]", "along_m"),
        (WAND, "[0, 0.15, 0.5]", "[0, 0.5, 0.15]", "must rise by more than"),
        (WAND, "0.014", "nan", "key 'diameter_m': nan given"),
        (FRAME, "[0, 0.4, 0.02]", "[0, 0.6, 0.02]", "markers 'x' and 'y' can be taken for each other"),
        (FRAME, "[0, 0.4, 0.02]", "[0.2, 0, 0.02]", "the markers lie in a line"),
        (BAR, "numbers = [3, 4]", "numbers = [3, 3]", "number 003 stands at both ends"),
        (BAR, "numbers = [3, 4]", "", "'numbers' and 'dot_radius_m' go together"),
        (BAR, "dot_radius_m = 0.008", "", "give one of 'dot_radius_m'"),
        (BAR, "sigma_m = 5e-6", "sigma_m = -1", "key 'sigma_m': -1 given"),
    ],
)
def test_a_wrong_file_is_explained(tmp_path, text, old, new, said):
    assert old in text
    with pytest.raises(InputError) as error:
        read(tmp_path, text.replace(old, new, 1))
    assert str(tmp_path / "target.toml") in str(error.value)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_the_schema_knows_all_kinds():
    schema = target_schema()
    assert set(schema["discriminator"]["mapping"]) == {"points", *TABLES}


quiet = settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
coordinate = st.floats(-1000, 1000)
triple = st.tuples(coordinate, coordinate, coordinate)


@quiet
@given(st.lists(st.tuples(st.one_of(st.none(), st.integers(0, 506)), triple, triple), min_size=1, max_size=5))
def test_a_field_is_written_and_read_again(tmp_path, rows):
    placed = []
    for k, (number, position, normal) in enumerate(rows):
        if np.linalg.norm(normal) < 1e-3:
            continue
        target = RoundTarget(0.02) if number is None else CodedTarget(number, 0.01, 0.021, 0.03, 0.07)
        placed.append(PlacedTarget(f"t{k}", target, np.array(position), np.array(normal)))
    if not placed:
        return
    field = TestField(tuple(placed), 1e-5)
    again = read(tmp_path, target_toml(field))
    assert isinstance(again, TestField)
    assert (again.names, again.sigma_m) == (field.names, field.sigma_m)
    assert [p.target for p in again.targets] == [p.target for p in field.targets]
    np.testing.assert_array_equal(again.positions, field.positions)
    for a, b in zip(again.targets, field.targets, strict=True):
        np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-12)


@quiet
@given(st.binary(max_size=200) | st.sampled_from([FIELD, BOARD, WAND, FRAME, BAR]).map(str.encode))
def test_any_bytes_are_read_or_refused(tmp_path, content):
    path = tmp_path / "any.toml"
    path.write_bytes(content)
    with contextlib.suppress(InputError):
        read_target_file(path)


values = st.recursive(
    st.one_of(st.floats(), st.integers(-(2**63), 2**63 - 1), st.booleans(), st.text(max_size=5), triple.map(list)),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["name", "number"]), inner),
    max_leaves=6,
)
KEYS = sorted({key for table in TABLES.values() for key in table.model_fields} - {"kind"})


@settings(quiet, max_examples=150)
@given(st.sampled_from(sorted(TABLES)), st.dictionaries(st.sampled_from(KEYS), values, max_size=5), st.data())
def test_any_values_are_read_or_refused(tmp_path, kind, changes, data):
    """Well-formed files of which a few keys hold anything."""
    base = {"field": FIELD, "board": BOARD, "wand": WAND, "light": LIGHT, "l_frame": FRAME, "scale_bar": BAR}[kind]
    document = tomllib.loads(base)
    keep = {k: v for k, v in changes.items() if data.draw(st.booleans()) or k in document}
    path = tmp_path / "any.toml"
    path.write_text(tomli_w.dumps(document | keep))
    with contextlib.suppress(InputError):
        read_target_file(path)


@pytest.mark.parametrize(
    "target",
    [
        Board(9, 6, 0.04, 0.03, sigma_m=1e-5),
        Board(8, 6, 0.04, 0.03, 0.03, "DICT_5X5_50", inverted=True, from_behind=True),
        Wand((0.0, 0.15, 0.5), 0.014, 1e-5),
        SingleLight(("left", "right"), 2.31, 0.5, "corner"),
        SingleLight(),
        ScaleBar(1.00012, 5e-6, (CodedTarget.of_dot(3, 0.008), CodedTarget.of_dot(4, 0.008))),
        ScaleBar(1.0, 0.0, (RoundTarget(0.01), RoundTarget(0.01))),
        ScaleBar(1.0, 0.0, (BallTarget(0.014), BallTarget(0.014))),
    ],
)
def test_other_targets_are_written_and_read_again(tmp_path, target):
    assert read(tmp_path, target_toml(target)) == target


def test_an_l_frame_is_written_and_read_again(tmp_path):
    places = np.array([[0.0, 0, 0], [0.5, 0, 0], [0, 0.3, 0], [0, 0.1, 0]])
    frame = LFrame(("o", "x", "y", "z"), places, 0.014, 1e-4)
    again = read(tmp_path, target_toml(frame))
    assert isinstance(again, LFrame)
    assert (again.names, again.diameter_m, again.sigma_m) == (frame.names, frame.diameter_m, frame.sigma_m)
    np.testing.assert_array_equal(again.positions, frame.positions)


def test_a_field_of_two_sizes_has_no_file():
    placed = tuple(
        PlacedTarget(f"t{k}", CodedTarget.of_dot(k, size), np.zeros(3), np.array([0.0, 0, 1]))
        for k, size in enumerate((0.01, 0.012))
    )
    with pytest.raises(ValueError, match=r"target 't1': dot_radius_m = 0\.012; those before it have 0\.01"):
        target_toml(TestField(placed, 0.0))
