"""Each fault on demand, as a client sees it and as the account tells it."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from natnet_clients import PATIENT_S, PERIOD_S, PlainClient, listening, server, take_frames, until, witness

from hardware.streams.fault_line import FaultLine
from hardware.streams.faults import KINDS, StreamFault, StreamFaults, fault_of, read_faults
from hardware.streams.moved_camera import MovedCamera
from hardware.streams.play import StreamPlayer, account_lines, looped
from hardware.streams.values import BODY, StreamFrame
from mosca.errors import InputError

START = 1000
SECONDS = 0.8


def line_of(frames, *faults, seed=0):
    return FaultLine(StreamFaults(seed=seed, program=faults), frames.model, frames.numbers)


def played(*faults, seconds=SECONDS, expect, seed=0, **settings):
    """Play a take through faults to a plain client; return its frames, and each fault's account."""
    frames = take_frames(seconds=seconds)
    line = line_of(frames, *faults, seed=seed)
    with server(frames.model, **settings) as served, PlainClient(served.command_port) as client:
        player = StreamPlayer(served, line)
        listening(served)
        player.play(frames, PERIOD_S)
        until(lambda: len(client.frames) == expect, lambda: (numbers(client.frames), served.lines()))
        assert player.played == len(frames)
        return client.frames, line.accounts


def numbers(frames):
    return [one.number - START for one in frames]


def between(account, count, first_s, last_s):
    assert account.count == count
    assert account.first_s == pytest.approx(first_s, abs=1e-6)
    assert account.last_s == pytest.approx(last_s, abs=1e-6)


def test_without_faults_every_frame_comes_once_in_order():
    got, accounts = played(expect=80)
    assert numbers(got) == list(range(80))
    assert accounts == ()


def test_latency_delays_what_is_sent_and_not_its_stamps():
    got, (account,) = played(fault_of("latency=0.15@0.2+0.3"), expect=80)
    assert numbers(got) == list(range(80))  # those after it queue behind those that are late
    on_the_way = np.array([one.came - one.transmit for one in got])
    assert (on_the_way[20:50] > 0.15).all()
    mid = np.array([one.mid for one in got])
    np.testing.assert_allclose(np.diff(mid), PERIOD_S, atol=1e-6)
    between(account, 30, 0.2, 0.49)


def test_jitter_delays_by_what_is_drawn():
    got, (account,) = played(fault_of("jitter=0.1"), expect=80, seed=4)
    assert numbers(got) == list(range(80))
    drawn = np.random.default_rng([4, 0]).uniform(0.0, 0.1, 80)
    assert (np.array([one.came - one.transmit for one in got]) > drawn - 1e-6).all()
    between(account, 80, 0.0, 0.79)


def test_bursts_are_lost():
    got, (account,) = played(fault_of("burst-loss=7@0.1"), seconds=1.4, expect=126)
    assert numbers(got) == [k for k in range(140) if k not in range(10, 17) and k not in range(110, 117)]
    between(account, 14, 0.1, 1.16)


def test_the_rate_is_halved():
    got, (account,) = played(fault_of("half-rate@0.2+0.4"), expect=60)
    assert numbers(got) == [k for k in range(80) if not 20 <= k < 60 or k % 2 == 0]
    between(account, 20, 0.21, 0.59)


def test_messages_come_twice():
    got, (account,) = played(fault_of("duplicate=10@0.2+0.4"), expect=84)
    twice = [29, 39, 49, 59]
    assert numbers(got) == sorted([*range(80), *twice])
    between(account, 4, 0.29, 0.59)


def test_messages_change_places():
    got, (account,) = played(fault_of("reorder=20"), expect=80)
    expected = list(range(80))
    for k in (19, 39, 59):
        expected[k], expected[k + 1] = expected[k + 1], expected[k]
    assert numbers(got) == expected  # the last one, 79, has no successor
    between(account, 4, 0.19, 0.79)


def test_the_clock_is_ahead_and_comes_back():
    got, (account,) = played(fault_of("clock-offset=0.5@0.2+0.3"), expect=80)
    mid = np.array([one.mid for one in got])
    expected = np.arange(80) * PERIOD_S
    expected[20:50] += 0.5
    np.testing.assert_allclose(mid - mid[0], expected, atol=1e-6)
    np.testing.assert_allclose([one.timestamp - 5.0 for one in got], np.arange(80) * PERIOD_S, atol=1e-9)
    between(account, 30, 0.2, 0.49)


def test_the_clock_drifts_and_keeps_what_it_gained():
    got, (account,) = played(fault_of("clock-drift=20000@0.2+0.4"), expect=80)
    mid = np.array([one.mid for one in got])
    at = np.arange(80) * PERIOD_S
    np.testing.assert_allclose(mid - mid[0], at + 0.02 * np.clip(at - 0.2, 0.0, 0.4), atol=1e-6)
    between(account, 40, 0.2, 0.59)


def test_the_clock_that_answers_echoes_is_the_same():
    frames = take_frames(seconds=0.1)
    line = line_of(frames, fault_of("clock-offset=100"))
    with server(frames.model) as served:
        StreamPlayer(served, line).play(frames, PERIOD_S)
        before = time.monotonic_ns()
        ahead = served.clock_ns() - 100 * 10**9
        assert before <= ahead <= time.monotonic_ns()


def test_the_connection_is_lost_and_comes_back():
    got, (account,) = played(fault_of("connection-lost@0.2+0.3"), expect=50)
    assert numbers(got) == [*range(20), *range(50, 80)]
    between(account, 30, 0.2, 0.49)


def test_commands_are_not_heard_while_the_connection_is_lost():
    frames = take_frames(seconds=0.1)
    line = line_of(frames, fault_of("connection-lost"))
    with server(frames.model) as served, PlainClient(served.command_port) as client:
        line.steer(served, 0.0)
        client.send(10)
        until(lambda: served.counts["not heard"] == 1)
        assert served.counts["keep alive"] == 0


def test_the_server_starts_again_without_clients_and_with_frames_from_0():
    frames = take_frames(seconds=0.5)
    line = line_of(frames, fault_of("restart@0.2+0.1"))
    with server(frames.model) as served, PlainClient(served.command_port) as client:
        player = StreamPlayer(served, line)
        listening(served)
        port = served.command_port
        thread = threading.Thread(target=player.play, args=(looped(frames, PERIOD_S), PERIOD_S))
        thread.start()
        until(lambda: line.accounts[0].count == 10 and served.command_port == port and served.clients()[0].left)
        until(lambda: len(client.frames) == 20)
        client.connect()  # until then nothing comes
        until(lambda: len(client.frames) >= 40)
        player.stop()
        thread.join()
        assert served.clients()[0].left == ""
    got = client.frames
    assert [one.number for one in got[:20]] == list(range(START, START + 20))
    # time stamps go on: the 31st frame of the take is the first one of the server that started again
    assert [one.number for one in got[20:]] == [round((one.timestamp - 5.0) / PERIOD_S) - 30 for one in got[20:]]
    between(line.accounts[0], 10, 0.2, 0.29)


@pytest.fixture
def witnessed():
    """Play a take of 0.4 s through a fault to the package natnet; return what it got, its model, the account."""

    def play(fault):
        frames = take_frames(seconds=0.4)
        line = line_of(frames, fault)
        with server(frames.model) as served, witness(served) as (client, got, models):
            client.request_modeldef()
            until(lambda: models)
            listening(served)
            StreamPlayer(served, line).play(frames, PERIOD_S)
            until(lambda: len(got) == len(frames))
        return got, models[0], line.accounts[0]

    return play


ACTIVE = range(10, 30)


def test_labels_are_swapped(witnessed):
    fault = StreamFault(fault="label-swap", at_s=0.1, for_s=0.2, names=("M1", "M3"))
    got, _, account = witnessed(fault)
    for k, one in enumerate(got):
        # marker k is at x = k
        order = [0, 3, 2, 1] if k in ACTIVE else [0, 1, 2, 3]
        (everything,) = [s for s in one.marker_sets if s.model_name == "all"]
        assert [place[0] for place in everything.marker_pos_list] == order
        by_member = {m.marker_id: m.pos[0] for m in one.labeled_markers if not m.unlabeled}
        assert [by_member[n] for n in (1, 2, 3, 4)] == order
    between(account, 20, 0.1, 0.29)


def test_ghosts_stand_among_the_markers(witnessed):
    got, _, account = witnessed(fault_of("ghosts=3@0.1+0.2"))
    for k, one in enumerate(got):
        here = 3 if k in ACTIVE else 0
        assert len(one.unlabeled_marker_pos) == 2 + here
        assert len(one.labeled_markers) == 6 + here
        ghosts = [m for m in one.labeled_markers if m.model_id == 0 and m.id_num >= 60_000]
        assert len(ghosts) == here
        assert all(m.unlabeled and 0 <= m.pos[0] <= 5 for m in ghosts)
        if here and k > 10:
            assert [m.pos for m in ghosts] == [
                m.pos for m in got[10].labeled_markers if m.model_id == 0 and m.id_num >= 60_000
            ]
    between(account, 20, 0.1, 0.29)


def test_a_body_is_lost_and_keeps_its_pose(witnessed):
    fault = StreamFault(fault="body-lost", at_s=0.1, for_s=0.2, names=("cup",))
    got, model, account = witnessed(fault)
    (number,) = [one.id_num for one in model.rigid_bodies if one.name == "cup"]
    for k, one in enumerate(got):
        by_number = {b.id_num: b for b in one.rigid_bodies}
        assert by_number[number].tracking_valid == (k not in ACTIVE)
        # body b is at (b, 2, frame)
        assert by_number[number].pos[2] == (10 if k in ACTIVE else k)
        assert by_number[3 - number].tracking_valid
        assert by_number[3 - number].pos[2] == k
    between(account, 20, 0.1, 0.29)


def test_bodies_are_swapped(witnessed):
    got, _, account = witnessed(fault_of("body-swap@0.1+0.2"))
    for k, one in enumerate(got):
        assert [b.id_num for b in one.rigid_bodies] == [1, 2]
        assert [b.pos[0] for b in one.rigid_bodies] == ([1, 0] if k in ACTIVE else [0, 1])
    between(account, 20, 0.1, 0.29)


def test_a_moved_camera_displaces_what_it_sees(witnessed):
    """Markers fill 5 m along x: the camera stands 5 m beside their middle, at x = 7.5, and sees from x = 2.5 on."""
    got, model, account = witnessed(fault_of("camera-moved=0.4@0.1+0.2"))
    numbers = {one.name: one.id_num for one in model.rigid_bodies}
    for k, one in enumerate(got):
        turn = 0.1 if k in ACTIVE else 0.0  # a quarter of it
        y, since = k / 1000, (k - 10) / 1000
        for m, marker in enumerate(one.labeled_markers):
            seen = turn if m > 2.5 else 0.0
            away = np.array([-seen * since, seen * (m - 7.5), 0.0])
            np.testing.assert_allclose(marker.pos, np.array([m, y, 1.0]) + away, atol=1e-6)
            assert marker.residual == pytest.approx(np.hypot(2e-4, np.linalg.norm(away)), rel=1e-5)
        (everything,) = [s for s in one.marker_sets if s.model_name == "all"]
        np.testing.assert_array_equal(everything.marker_pos_list, [m.pos for m in one.labeled_markers[:4]])
        # bodies stand at x = 0 and 1, out of its view
        assert {b.id_num: b.pos[0] for b in one.rigid_bodies} == {numbers["drone"]: 0.0, numbers["cup"]: 1.0}
    between(account, 20, 0.1, 0.29)


def test_a_moved_camera_turns_bodies_in_its_view():
    """A body alone at (2, 0, 1) and one at the origin: the camera stands at (1 + sqrt 5, 0, 0.5)."""
    rows = np.zeros(2, BODY)
    rows["position"], rows["quaternion"] = [[0, 0, 0], [2, 0, 1]], [0, 0, 0, 1]
    far, near = MovedCamera(StreamFrame(0, 0.0, bodies=rows), 0.4).seen(StreamFrame(0, 0.0, bodies=rows)).bodies
    np.testing.assert_array_equal(far, rows[0])
    np.testing.assert_allclose(near["position"], [2.0, 0.1 * (1 - np.sqrt(5)), 1.0], rtol=1e-6)
    np.testing.assert_allclose(near["quaternion"], [0, 0, np.sin(0.05), np.cos(0.05)], rtol=1e-6)
    assert near["error"] == pytest.approx(0.1 * (np.sqrt(5) - 1), rel=1e-6)


def test_a_programme_over_time(tmp_path):
    (tmp_path / "faults.toml").write_text(
        'seed = 3\n[[program]]\nfault = "burst-loss"\nvalue = 5\nat_s = 0.1\nfor_s = 0.5\n'
        '[[program]]\nfault = "half-rate"\nat_s = 0.6\n[[program]]\nfault = "latency"\nat_s = 60\n'
    )
    made = read_faults(tmp_path / "faults.toml")
    assert made.seed == 3
    got, accounts = played(*made.program, expect=65)
    assert numbers(got) == [k for k in range(80) if k not in range(10, 15) and not (k >= 60 and k % 2)]
    assert [account.count for account in accounts] == [5, 10, 0]
    assert accounts[2].line() == "fault latency 0.05: not made, it was ordered from 60 s on"
    assert accounts[0].line() == "fault burst-loss 5: 5 frames from 0.100 s to 0.140 s"


def test_the_account_names_frames_clients_commands_and_faults():
    frames = take_frames(seconds=0.2)
    line = line_of(frames, fault_of("duplicate=10"))
    with server(frames.model) as served, PlainClient(served.command_port) as client:
        player = StreamPlayer(served, line)
        listening(served)
        player.play(frames, PERIOD_S)
        until(lambda: len(client.frames) == 22, lambda: (account_lines(player, 0.2, line), client.frames))
        told = account_lines(player, 0.2, line)
    assert told[0].startswith("20 frames in 0.2 s, p99 ")
    assert told[1] == f"127.0.0.1:{client.address[1]}: 22 frames sent, 0 dropped"
    assert told[3] == "fault duplicate 10: 2 frames from 0.090 s to 0.190 s"


def test_a_take_goes_on_in_a_loop():
    frames = take_frames(seconds=0.05)
    endless = looped(frames, PERIOD_S)
    got = [next(endless) for _ in range(12)]
    assert [one.number for one in got] == list(range(START, START + 12))
    np.testing.assert_allclose([one.timestamp_s for one in got], 5.0 + np.arange(12) * PERIOD_S, atol=1e-9)
    assert list(looped([], PERIOD_S)) == []


def test_playing_stops_at_once_and_after_seconds():
    frames = take_frames(seconds=0.05)
    with server(frames.model) as served:
        player = StreamPlayer(served)
        thread = threading.Thread(target=player.play, args=(looped(frames, 1e5), 1e5))
        thread.start()  # the second round is due in a day
        until(lambda: player.played == 5)
        player.stop()
        thread.join(PATIENT_S)
        assert not thread.is_alive()
        other = StreamPlayer(served)
        other.play(looped(frames, PERIOD_S), PERIOD_S, seconds=0.095)
        assert other.played == 10
        fast = StreamPlayer(served, speed=None)
        fast.play(frames, PERIOD_S)
        assert fast.played == 5


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("latenz", "NAME\\[=VALUE\\]"),
        ("latency=", "NAME\\[=VALUE\\]"),
        ("latency=1.2.3", "a number is wanted"),
        ("latency=-1", "0 to 10 is wanted"),
        ("latency@1+0", "for_s"),
        ("duplicate=1.5", "whole number"),
        ("ghosts=0", "whole number"),
        ("clock-drift=1e9", "-1000000 to 1000000"),
    ],
)
def test_a_fault_that_cannot_be_is_told_in_one_line(text, told):
    with pytest.raises(InputError, match=told) as error:
        fault_of(text)
    assert "\n" not in str(error.value)
    assert text in str(error.value)


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        (StreamFault(fault="body-lost", names=("cap",)), "no 'cap' in the stream; its bodies: drone, cup"),
        (StreamFault(fault="label-swap", names=("M0", "M9")), "no 'M9' in the stream; its labels: M0, M1, M2, M3"),
    ],
)
def test_names_that_are_not_there_are_told(fault, told):
    frames = take_frames(seconds=0.02)
    with pytest.raises(InputError, match=told):
        line_of(frames, fault)


def test_a_stream_without_bodies_cannot_lose_one():
    frames = take_frames(seconds=0.02, bodies=())
    with pytest.raises(InputError, match="1 bodies are wanted; the stream's: none"):
        line_of(frames, fault_of("body-lost"))


def test_every_kind_has_a_test():
    text = Path(__file__).read_text(encoding="utf-8")
    assert all(f'"{kind}' in text for kind in KINDS)
