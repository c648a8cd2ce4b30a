"""NatNet messages against recorded traffic of Motive and against the package ``natnet``, which reads them."""

import struct

import numpy as np
import pytest
from natnet_witness import datagrams, frame_of, models_of, parsed_frame, parsed_model

from hardware.streams.natnet import messages
from hardware.streams.natnet.messages import VERSIONS, FrameStamps
from hardware.streams.values import BODY, MARKER, StreamedBody, StreamedSet, StreamedSkeleton, StreamFrame

STAMPS = FrameStamps(10**13 + 1, 10**13 + 50_001, 10**13 + 70_001)


def frame_message(frame, stamps, version):
    """Return one frame of data as the server sends it."""
    return messages.stamped(messages.unstamped_frame(frame, version), stamps, version)


@pytest.fixture(scope="module")
def traffic(data_dir):
    folder = data_dir / "natnet"
    if not folder.is_dir():
        pytest.skip("no recorded NatNet traffic (natnet in the folder of real data)")
    return folder


def some_frame(seed=3, params=0):
    """Return a frame with something of everything."""
    rng = np.random.default_rng(seed)

    def bodies(n):
        made = np.zeros(n, BODY)
        made["id"], made["position"], made["error"] = np.arange(1, n + 1), rng.normal(size=(n, 3)), rng.random(n)
        made["quaternion"], made["params"] = rng.normal(size=(n, 4)), rng.integers(0, 2, n)
        return made

    markers = np.zeros(20, MARKER)
    markers["id"], markers["position"] = rng.integers(0, 2**32, 20), rng.normal(size=(20, 3))
    markers["size"], markers["params"], markers["residual"] = rng.random(20), rng.integers(0, 32, 20), rng.random(20)
    sets = (("drone", rng.normal(size=(4, 3))), ("", np.empty((0, 3))), ("alle ä", rng.normal(size=(7, 3))))
    skeletons = ((9, bodies(3)), (10, bodies(0)))
    return StreamFrame(
        2**31 + 5,
        12.3456789,
        sets,
        rng.normal(size=(5, 3)),
        bodies(6),
        skeletons,
        markers,
        timecode=(7, 8),
        params=params,
    )


@pytest.mark.data
def test_recorded_frames_are_encoded_to_the_byte(traffic):
    """518 frames of a session, and two of other takes with marker sets and an occluded marker."""
    frames = [data for _, data in datagrams(traffic / "traffic.pcapng") if data[:2] == b"\x07\x00"]
    assert len(frames) == 518
    frames += [path.read_bytes() for path in sorted(traffic.glob("mocapframe*.bin"))]
    for data in frames:
        found, _ = parsed_frame(data, (3, 0))
        frame, stamps = frame_of(found)
        assert frame_message(frame, stamps, (3, 0)) == data


@pytest.mark.data
def test_recorded_answers_are_encoded_to_the_byte(traffic):
    recorded = [data for _, data in datagrams(traffic / "traffic.pcapng")]
    (model,) = [data for data in recorded if data[:2] == b"\x05\x00"]
    found, end = parsed_model(model, (3, 0))
    assert end == len(model)
    mine = messages.model_message(models_of(found), (3, 0))
    assert mine == model
    asked = [messages.taken_apart(data) for data in recorded if data[:2] == b"\x0c\x00"]
    answers = [data for data in recorded if data[:2] == b"\x0d\x00"]
    assert len(asked) == len(answers) == 9
    for command, answer in zip(asked, answers, strict=True):
        (now,) = struct.unpack_from("<Q", answer, 12)
        assert messages.echo_answer(command.payload, now) == answer
    values = [data for data in recorded if data[:2] == b"\x03\x00" and len(data) == 8]
    assert [messages.response(120.0), messages.response(0)] == values
    # Motive leaves old bytes behind the name: all but these
    (info,) = {data for source, data in datagrams(traffic / "traffic.pcapng") if data[:2] == b"\x01\x00"}
    mine = messages.server_info("Motive", (2, 1, 0, 0), (3, 0), 1511, "239.255.42.99")
    assert (mine[:11], mine[260:268], len(mine)) == (info[:11], info[260:268], len(info))
    assert mine[276:] == info[276:]
    (unknown,) = [data for data in recorded if data[:2] == b"\x64\x00"]
    assert len(messages.unrecognised("mosca", (0, 2, 0, 0), (3, 0))) == len(unknown)


@pytest.mark.data
def test_recorded_commands_are_taken_apart(traffic):
    recorded = [messages.taken_apart(d) for source, d in datagrams(traffic / "traffic.pcapng") if source > 40000]
    kinds = [one.kind for one in recorded]
    assert kinds.count(messages.ECHO) == 9
    assert kinds.count(messages.REQUEST) == 4
    texts = [one.text for one in recorded if one.kind == messages.REQUEST]
    assert texts[1:] == ["FrameRate", "AnalogSamplesPerMocapFrame", "TestRequest"]
    assert kinds[:2] == [messages.DISCOVER, messages.CONNECT]


@pytest.mark.parametrize("version", VERSIONS)
def test_the_witness_reads_every_field(version):
    # the witness knows no precision stamp, which stands before the flags from 4.1 on
    frame = some_frame(params=3 if version < (4, 1) else 0)
    message = frame_message(frame, STAMPS, version)
    found, end = parsed_frame(message, version)
    again, stamps = frame_of(found)
    assert stamps == STAMPS
    assert (again.number, again.timestamp_s, again.timecode, again.params) == (
        frame.number, frame.timestamp_s, frame.timecode, frame.params,
    )  # fmt: skip
    assert [name for name, _ in again.marker_sets] == [name for name, _ in frame.marker_sets]
    for (_, mine), (_, theirs) in zip(frame.marker_sets, again.marker_sets, strict=True):
        np.testing.assert_array_equal(mine.astype("f4"), theirs)
    np.testing.assert_array_equal(frame.other.astype("f4"), again.other)
    np.testing.assert_array_equal(frame.bodies, again.bodies)
    np.testing.assert_array_equal(frame.markers, again.markers)
    assert [number for number, _ in again.skeletons] == [9, 10]
    np.testing.assert_array_equal(frame.skeletons[0][1], again.skeletons[0][1])
    assert len(message) - end == (4 if version < (4, 1) else 12)  # the tag at the end, and the precision stamp
    assert struct.unpack_from("<H", message, 2)[0] == len(message) - 4


@pytest.mark.parametrize("version", VERSIONS)
def test_the_witness_reads_the_model(version):
    places = ((0.125, 0.0, -0.5), (0.25, 1.0, 0.0))
    body = StreamedBody("drone", 1, ("D1", "D2"), places, 4, (0.5, 0.25, -0.125))
    model = [
        body,
        StreamedSet("drone", ("D1", "D2")),
        StreamedSkeleton("Ärla", 7, (body, StreamedBody("hip", 2))),
        StreamedSet("all", ("D1", "D2", "")),
    ]
    message = messages.model_message(model, version)
    found, end = parsed_model(message, version)
    assert end == len(message)
    again = models_of(found)
    unnamed = version < (4, 0)  # markers of bodies have names from 4.0 on

    def expected(one):
        return StreamedBody(
            one.name, one.number, ("",) * len(one.markers) if unnamed else one.markers, one.positions, one.parent,
            one.offset,
        )  # fmt: skip

    bones = StreamedSkeleton("Ärla", 7, (expected(body), StreamedBody("hip", 2)))
    assert again == [expected(body), model[1], model[3], bones]


def test_a_message_that_no_datagram_holds_is_refused():
    crowd = StreamFrame(1, 0.0, markers=np.zeros(2600, MARKER))
    with pytest.raises(ValueError, match="65507 fit"):
        frame_message(crowd, STAMPS, (3, 1))


@pytest.mark.parametrize("datagram", [b"", b"\0", b"\0\0\0", b"\x02\0\x05\0Ping"])
def test_what_is_shorter_than_it_says_is_no_command(datagram):
    assert messages.taken_apart(datagram) is None
