"""Live runs: bounded delay, whole sets left out and counted, errors raised in the iteration."""

import threading
import time

import numpy as np
import pytest

from mosca.data.frames import CameraInfo, Frame
from mosca.errors import InputError
from mosca.live import LiveSets, run_live
from mosca.pipeline import PipelineSettings, run
from mosca.precompile import _Blobs, _rig
from mosca.synchronisation import Assembly

INFOS = tuple(CameraInfo(name, 8, 6, 8, 100.0) for name in ("a", "b"))
IMAGE = np.zeros((6, 8), np.uint8)


class Paced:
    """Sends ``pulses`` frame sets as fast as the gate opens; may break after some."""

    def __init__(self, pulses: int, breaks_at: int | None = None) -> None:
        self.cameras, self.pulses, self.breaks_at = INFOS, pulses, breaks_at
        self.sent = threading.Event()

    def __iter__(self):
        for pulse in range(self.pulses):
            if pulse == self.breaks_at:
                raise OSError("the cable is out")
            for info in INFOS:
                yield Frame(info.name, pulse, pulse * 10_000_000, 1_000_000, IMAGE)
        self.sent.set()

    def close(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass


def test_a_slow_reader_gets_the_newest_sets_and_every_other_is_counted():
    source, assembly = Paced(50), Assembly()
    sets = LiveSets(source, assembly, queued=3)
    assert source.sent.wait(60)
    deadline = time.monotonic() + 60
    while assembly.sets < 50 and time.monotonic() < deadline:
        time.sleep(0.001)
    got = [one.pulse for one in sets]
    sets.close()
    assert got == [47, 48, 49]
    assert assembly.skipped_sets == 47
    assert "left out whole" in assembly.notes["skipped"]


def test_a_fast_reader_misses_nothing():
    # the queue is longer than the source, so that a busy machine cannot make it overflow
    assembly = Assembly()
    sets = LiveSets(Paced(40), assembly, queued=100)
    assert [one.pulse for one in sets] == list(range(40))
    assert assembly.skipped_sets == 0
    sets.close()


def test_an_error_of_the_source_is_raised_where_one_iterates():
    sets = LiveSets(Paced(20, breaks_at=12), queued=100)
    with pytest.raises(OSError, match="cable"):
        list(sets)
    sets.close()


def test_no_queue_is_an_input_error():
    with pytest.raises(InputError, match="queued = 0"):
        LiveSets(Paced(1), queued=0)


def test_what_a_live_run_measures_is_what_a_patient_one_does():
    rig = _rig()
    patient = list(run(_Blobs(rig), rig, PipelineSettings(lookahead=0)))
    live = list(run_live(_Blobs(rig), rig, queued=100))
    assert [s.frame_set.pulse for s in live] == [s.frame_set.pulse for s in patient]
    for a, b in zip(live, patient, strict=True):
        np.testing.assert_array_equal(a.points.xyz, b.points.xyz)
        assert a.seconds["wait"] >= 0.0


@pytest.mark.parametrize("threads", [{"workers": n} for n in (1, 2, 3, 8)] + [{"split": n} for n in (2, 3, 8)])
def test_threads_change_nothing(threads):
    rig = _rig()
    alone = list(run(_Blobs(rig), rig))
    for other, one in zip(run(_Blobs(rig), rig, PipelineSettings(**threads)), alone, strict=True):
        assert other.frame_set.pulse == one.frame_set.pulse
        assert list(other.detections) == list(one.detections)
        np.testing.assert_array_equal(other.points.xyz, one.points.xyz)
        np.testing.assert_array_equal(other.points.covariance, one.points.covariance)
