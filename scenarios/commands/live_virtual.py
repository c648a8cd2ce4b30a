"""Tracked bodies of a live run move objects of a second scene, which a display shows at a rate of its own."""

import statistics
import threading
import time
from array import array
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.bodies import RigidBody
from mosca.data.tracks import Samples
from mosca.errors import InputError
from mosca.formats.bodies.body_file import read_bodies
from mosca.rigid_bodies.prediction import PredictionSettings
from mosca.rigid_bodies.tracker import BodyTracker
from reports.viewer import RerunLog
from scenarios.commands.live_sources import LiveOptions, LiveSource
from scenarios.score.bodies import rigid_bodies
from scenarios.score.virtual_objects import object_errors
from scenarios.virtual.objects import SHOWN_STATUSES, BoundObjects, ShownObject, ShownPoses, bindings
from scenarios.virtual.scene import Placement, VirtualScene

DISPLAY_HZ = 60.0
DRAWS = 31
"""Number of displays whose median time from prediction to hand-over is the prediction time of the next display."""


@dataclass(eq=False)
class _Displayed:
    """Account of the displays: latencies and ages [s], counts of statuses, and rows to be compared with a truth."""

    latency_s: array = field(default_factory=lambda: array("d"))  # type: ignore[type-arg]
    """Time from the middle of the newest exposure of a body to the hand-over of its object."""
    aimed_s: array = field(default_factory=lambda: array("d"))  # type: ignore[type-arg]
    """Time from the predicted instant to the hand-over."""
    statuses: dict[str, Counter[str]] = field(default_factory=dict)
    rows: list[ShownObject] = field(default_factory=list)
    """Objects at the predicted instants."""
    handed: list[ShownObject] = field(default_factory=list)
    """The same objects at the instants of hand-over."""
    displays: int = 0


class LiveVirtual:
    """Bodies followed in a live run, and the thread that displays the objects that they move.

    The poses of each display are predicted to the instant of its hand-over: now plus the drawing time of the last
    displays. ``close`` ends the thread.
    """

    def __init__(self, options: LiveOptions, source: LiveSource, logs: Sequence[RerunLog]) -> None:
        assert options.virtual is not None
        self._bodies = _bodies(options, source)
        where = str(options.bodies or options.source)
        bound = bindings(options.bind, [one.name for one in self._bodies], where)
        self._scene = VirtualScene(options.virtual, tuple(bound))
        settings = PredictionSettings() if options.horizon is None else PredictionSettings(horizon_s=options.horizon)
        self._objects = BoundObjects(bound, settings)
        self._tracker = BodyTracker([one for one in self._bodies if one.name in bound.values()])
        self._options, self._source, self._logs = options, source, logs
        self._period_s = 1.0 / (options.display_hz or DISPLAY_HZ)
        self._lead_ns = round(1e9 * (options.display_lead or 0.0))
        self._delay_ns = round(1e9 * (options.display_delay or 0.0))
        self._done = _Displayed()
        self._failed: Exception | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="display", daemon=True)

    def start(self) -> None:
        """Log the scene's shapes, compile the filters, and begin to display."""
        _compile(self._bodies)
        for log in self._logs:
            for k, (body, vertices, triangles, colour) in enumerate(self._scene.meshes()):
                log.log_object_mesh(body, k, vertices, triangles, colour)
        self._thread.start()

    def step(self, frame: int, time_ns: int, samples: Samples) -> None:
        """Take the tracker's samples of one frame set. Raises the error that ended the display, if any."""
        if self._failed is not None:
            raise self._failed
        self._objects.update(self._tracker.update(samples, frame, time_ns))

    def close(self) -> None:
        """End the display; may be called twice."""
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join()

    def finish(self) -> tuple[list[str], dict[str, Any]]:
        """End the display and return the lines to print, and the same figures for the record's counts."""
        self.close()
        done = self._done
        if not done.latency_s:
            return ["virtual objects: no body was found; are its markers seen?"], {}
        rate = (self._options.display_hz or DISPLAY_HZ, done.displays)
        latency, aimed = _quantiles(done.latency_s), _quantiles(np.abs(np.array(done.aimed_s)))
        figures: dict[str, Any] = {
            "displays": done.displays,
            "latency_s": latency,
            "off_instant_s": aimed,
            "statuses": {name: dict(count) for name, count in done.statuses.items()},
        }
        lines = [
            f"virtual objects: {rate[1]} displays at {rate[0]:g} Hz; from exposure to display {_ms(latency)} "
            "(to the hand-over; the display's own delay is not measured)",
            f"handed over beside the instant that was predicted: {_ms(aimed)}",
        ]
        for name, count in done.statuses.items():
            told = ", ".join(f"{count[one]} {one}" for one in SHOWN_STATUSES if count[one])
            lines.append(f"{self._objects.bound[name]} -> {name}: {told}")
        if self._scene.left_out_s:
            lines.append(f"physics of {self._scene.left_out_s:.2f} s left out: the scene is slower than real time")
        if self._source.scene is not None:
            more, errors = self._beside_truth()
            lines, figures = lines + more, figures | {"errors": errors}
        return lines, {"virtual": figures}

    def _beside_truth(self) -> tuple[list[str], dict[str, Any]]:
        assert self._source.scene is not None
        shown, meant = ShownPoses.of(self._done.handed), ShownPoses.of(self._done.rows)
        errors = object_errors(shown, self._bodies, self._source.scene)
        aimed = object_errors(meant, self._bodies, self._source.scene)
        lines, figures = [], {}
        for status in SHOWN_STATUSES:
            rows = (shown.status == status) & np.isfinite(errors.position_m).all(axis=1)
            rows &= np.isfinite(aimed.position_m).all(axis=1)
            if not rows.any():
                continue
            away, turned = _rms(errors.position_m[rows]), _rms(errors.rotation_rad[rows])
            late, late_turned = _rms(errors.unpredicted_m[rows]), _rms(errors.unpredicted_rad[rows])
            predicted, predicted_turned = _rms(aimed.position_m[rows]), _rms(aimed.rotation_rad[rows])
            figures[status] = {
                "n": int(rows.sum()), "position_rms_m": away, "angle_rms_rad": turned,
                "unpredicted_position_rms_m": late, "unpredicted_angle_rms_rad": late_turned,
                "at_instant_position_rms_m": predicted, "at_instant_angle_rms_rad": predicted_turned,
            }  # fmt: skip
            lines.append(
                f"{status}: objects off by {1e3 * away:.3g} mm and {1e3 * turned:.3g} mrad rms; at the instants that "
                f"were predicted {1e3 * predicted:.3g} mm and {1e3 * predicted_turned:.3g} mrad; the newest pose as "
                f"measured {1e3 * late:.3g} mm and {1e3 * late_turned:.3g} mrad"
            )
        return lines, figures

    def _run(self) -> None:
        try:
            self._display()
        except Exception as error:  # kept, and raised in the thread that tracks
            self._failed = error

    def _display(self) -> None:
        drawn: deque[float] = deque([0.0], maxlen=DRAWS)
        due = time.monotonic()
        while not self._over.wait(max(0.0, due - time.monotonic())):
            began = time.monotonic()
            due = max(due + self._period_s, began)
            # physics takes most of the time of a display and yields to other threads at each of its steps: it comes
            # first, so that the shown poses are predicted over the drawing time only
            if (pushed := self._predicted(began, statistics.median(drawn))) is None:
                continue
            self._scene.show(began, _placed(pushed[1]))
            ready = time.monotonic()
            if (found := self._predicted(ready, statistics.median(drawn))) is None:
                continue
            aim_ns, shown = found
            self._scene.place(_placed(shown))
            placed = self._scene.placements()
            for log in self._logs:
                log.log_objects(aim_ns + self._lead_ns, placed, {one.object: one.pose.status for one in shown})
            handed = time.monotonic()
            drawn.append(handed - ready)
            handed_ns = self._source.session_ns(round(1e9 * handed))
            if shown and handed_ns is not None:
                self._account(shown, aim_ns, handed_ns)

    def _predicted(self, now_s: float, ahead_s: float) -> tuple[int, list[ShownObject]] | None:
        """Return the instant ``ahead_s`` after ``now_s`` [s] on the frames' clock [ns], and the objects at it."""
        aim_ns = self._source.session_ns(round(1e9 * (now_s + ahead_s)))
        return None if aim_ns is None else (aim_ns, self._objects.at(aim_ns + self._lead_ns, self._delay_ns))

    def _account(self, shown: Sequence[ShownObject], aim_ns: int, handed_ns: int) -> None:
        done = self._done
        done.displays += 1
        done.aimed_s.append((handed_ns - aim_ns) * 1e-9)
        for one in shown:
            done.latency_s.append((handed_ns - one.pose.newest_ns) * 1e-9)
            done.statuses.setdefault(one.object, Counter())[one.pose.status] += 1
            if self._source.scene is not None:
                done.rows.append(one)
                # compared with the truth also at the real hand-over, not only at the intended one
                off_ns = handed_ns - aim_ns
                done.handed.append(one._replace(time_ns=one.time_ns + off_ns, meant_ns=one.meant_ns + off_ns))


def live_virtual(
    options: LiveOptions, source: LiveSource, logs: Sequence[RerunLog], stack: ExitStack
) -> LiveVirtual | None:
    """Return the display of the objects of ``--virtual``, closed with ``stack``; None without that option."""
    if options.virtual is None:
        return None
    made = LiveVirtual(options, source, logs)
    stack.callback(made.close)
    return made


def check_virtual(options: LiveOptions) -> None:
    """Raise InputError for options of virtual objects that cannot be combined."""
    if options.virtual is None:
        own = () if options.stream else ("bodies",)
        for name in (*own, "display_hz", "display_lead", "display_delay", "horizon"):
            if (value := getattr(options, name)) is not None:
                raise InputError(
                    f"--{name.replace('_', '-')} {value}: is of virtual objects; give --virtual SCENE.xml"
                    + (" or --stream natnet" if name == "bodies" else "")
                )
        if options.bind:
            raise InputError(f"--bind {options.bind[0]}: of which scene is the object? give --virtual SCENE.xml")
    elif not options.bind:
        raise InputError(f"--virtual {options.virtual}: nothing moves it; give --bind BODY=OBJECT, as drone=cup")


def _bodies(options: LiveOptions, source: LiveSource) -> tuple[RigidBody, ...]:
    if options.bodies is not None:
        return read_bodies(options.bodies)
    if source.scene is None:
        raise InputError(f"{options.source}: --bodies BODIES.toml is wanted; 'mosca bodies learn' writes it")
    return rigid_bodies(source.scene)


def _compile(bodies: Sequence[RigidBody]) -> None:
    """Follow the bodies at rest over some frames, and predict between and ahead of them, so that all is compiled."""
    tracker, objects = BodyTracker(bodies), BoundObjects({one.name: one.name for one in bodies})
    # placed apart, so that none can be taken for another
    apart = [one.positions + [3.0 * k, 0.0, 0.0] for k, one in enumerate(bodies)]
    xyz = np.concatenate(apart)
    n = len(xyz)
    for frame in range(4):
        time_ns = frame * 10_000_000
        row, rest = np.full(n, frame), (np.full(n, 4), np.zeros(n), np.zeros(n, np.int8))
        samples = Samples(row, np.full(n, time_ns), np.arange(n), xyz, np.tile(1e-8 * np.eye(3), (n, 1, 1)), *rest)
        objects.update(tracker.update(samples, frame, time_ns))
    for time_ns in (15_000_000, 40_000_000):
        objects.at(time_ns)


def _placed(shown: Sequence[ShownObject]) -> dict[str, Placement]:
    return {one.object: (one.pose.rotation, one.pose.position) for one in shown}


def _quantiles(values: Any) -> dict[str, float]:
    seconds: Array = np.asarray(values, dtype=np.float64)
    p50, p99 = np.quantile(seconds, [0.5, 0.99])
    return {"p50": float(p50), "p99": float(p99), "max": float(seconds.max())}


def _ms(found: dict[str, float]) -> str:
    return f"{1e3 * found['p50']:.1f} ms, p99 {1e3 * found['p99']:.1f} ms, at most {1e3 * found['max']:.1f} ms"


def _rms(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))
