"""Monitoring of a running rig: detects bumps, and re-orients a bumped camera from points tracked by the others.

``mosca.pipeline.run`` takes it as its keeper: it is given each frame set's points and provides the rig for the next.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mosca.calibration.monitoring.bump_detector import Alarm, BumpDetector
from mosca.calibration.monitoring.reorient import CameraObservations, Reorientation, common_shift, gather, reoriented
from mosca.data.detections import Detections
from mosca.data.rig import Rig
from mosca.data.tracks import Points
from mosca.errors import MoscaError

REORIENT_FRAMES = 30
"""Number of frames after a bump from which the new pose is estimated, so that the body's shake averages out."""


@dataclass(frozen=True, eq=False)
class Incident:
    """What happened to a rig while it ran: an ``alarm`` raised at frame ``at``; ``mended`` at frame ``mended_at``
    (-1: not), with the ``reorientation`` or the reason ``why_not``.
    """

    alarm: Alarm
    at: int
    mended_at: int = -1
    reorientation: Reorientation | None = None
    why_not: str = ""

    @property
    def message(self) -> str:
        """The incident in a line."""
        if self.reorientation is None:
            return f"frame {self.at}: {self.alarm.message}" + (f" ({self.why_not})" if self.why_not else "")
        new = self.reorientation
        return (
            f"frame {self.at}: {self.alarm.message}; re-oriented at frame {self.mended_at} from "
            f"{int(new.used.sum())} points: turned by "
            f"{1e3 * new.turn_rad:.3f} mrad, moved by {1e3 * new.shift_m:.2f} mm"
        )


class RigKeeper:
    """A keeper of the pipeline: the current ``rig`` and the ``incidents`` so far."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.incidents: list[Incident] = []
        self._watch = BumpDetector(rig)
        self._recent: deque[tuple[int, Mapping[str, Detections], Points]] = deque(maxlen=REORIENT_FRAMES)
        self._open: Incident | None = None

    def attend(self, frame: int, detections: Mapping[str, Detections], points: Points) -> None:
        """Take a frame set's points; ``rig`` may have changed afterwards."""
        self._recent.append((frame, detections, points))
        if self._open is not None:
            # only frames since the bump determine the new pose
            if frame - self._open.alarm.since >= REORIENT_FRAMES:
                self._reorient(frame)
            return
        alarm = self._watch.update(frame, detections, points)
        if alarm is None:
            return
        incident = Incident(alarm, frame)
        if alarm.camera is not None:
            self._open = incident
        else:
            self.incidents.append(incident)

    def close(self) -> None:
        """End the watch: an incident that was waiting for more frames is kept as it is."""
        if self._open is not None:
            self.incidents.append(self._open)
            self._open = None

    def _reorient(self, frame: int) -> None:
        incident = self._open
        assert incident is not None
        assert incident.alarm.camera is not None
        name, since = incident.alarm.camera, incident.alarm.since
        far = not np.isfinite(incident.alarm.turn_rad).all()
        parts = []
        for number, detections, points in self._recent:
            if number >= since:
                shift = common_shift(self.rig, name, detections, points) if far else None
                parts.append(gather(self.rig, name, number, detections, points, shift))
        self._open = None
        try:
            self.rig, new = reoriented(self.rig, name, CameraObservations.joined(parts), self._watch.settings.body_px)
        except MoscaError as error:  # the run goes on with the old rig; the incident gives the reason
            self.incidents.append(Incident(incident.alarm, incident.at, why_not=str(error)))
        else:
            self.incidents.append(Incident(incident.alarm, incident.at, frame, new))
        self._watch.restart(self.rig)
