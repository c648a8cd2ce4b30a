"""Detection ahead of the caller: which thread detects a frame set, and how its errors are raised."""

import threading
from itertools import islice

import numpy as np
import pytest

from mosca.data.frames import Frame, FrameSet
from mosca.detection.detect import DetectionSettings
from mosca.detection.scheduler import FrameSetDetector, detect_ahead

PATIENCE_S = 60.0


def dark_sets(n):
    return [FrameSet(k, k, {"cam1": Frame("cam1", k, k, 1_000, np.zeros((16, 16), np.uint8))}) for k in range(n)]


class Held(FrameSetDetector):
    """The threads that detect ahead are held until the caller has detected a set itself."""

    def detect(self, frame_set, *more, **others):
        if threading.current_thread() is threading.main_thread():
            caller_looked.set()
        else:
            assert caller_looked.wait(PATIENCE_S)
        return super().detect(frame_set, *more, **others)


caller_looked = threading.Event()


@pytest.mark.parametrize("workers", [1, 2])
def test_the_caller_looks_at_a_set_itself_rather_than_wait(workers):
    caller_looked.clear()
    seen = list(detect_ahead(Held(DetectionSettings(), {"cam1": 8}), dark_sets(12), workers))
    assert [frame_set.pulse for frame_set, _, _ in seen] == list(range(12))
    assert caller_looked.is_set()


class Failing(FrameSetDetector):
    def detect(self, frame_set, *more, **others):
        if frame_set.pulse == 5:
            raise ArithmeticError("pulse 5")
        return super().detect(frame_set, *more, **others)


@pytest.mark.parametrize("workers", [0, 1, 3])
def test_an_error_comes_when_it_is_its_sets_turn(workers):
    ahead = detect_ahead(Failing(DetectionSettings(), {"cam1": 8}), dark_sets(9), workers)
    assert [frame_set.pulse for frame_set, _, _ in islice(ahead, 5)] == list(range(5))
    with pytest.raises(ArithmeticError, match="pulse 5"):
        next(ahead)
