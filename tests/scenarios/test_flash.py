"""Cameras synchronised by a light that flashes: instants by hand, the twin's clocks, and controls."""

import re
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import Camera, OpenCVLens, Pose
from mosca.diagnostics.light_marker.offsets import synchronise
from mosca.errors import InputError
from mosca.recording import RecordingWriter
from scenarios.cli.rig import rig_check
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.emission import Blink
from twin.scenes.target_lamps import build_light_marker, with_lamps
from twin.source import TwinSource

W, H, BITS = 24, 18, 12
EDGES_S = np.array([0.0531, 0.1777, 0.2609, 0.3314, 0.5013, 0.5555, 0.7321, 0.9011, 1.0407, 1.2289, 1.3717, 1.5001])


class Filmed:
    """Cameras before one lamp: ``cameras`` name -> (rate [Hz], phase [s], exposure [s], clock offset [s], drift)."""

    def __init__(self, cameras, edges=EDGES_S, until=1.7, light=1500.0, noise=8.0, row_time_ns=0, full=2**BITS - 1):
        self.words, self.edges, self.until = cameras, edges, until
        self.light, self.noise, self.row_time_ns, self.full = light, noise, row_time_ns, full
        self.cameras = tuple(CameraInfo(name, W, H, BITS, c[0], "device") for name, c in cameras.items())

    def lit_share(self, begin, end):
        """Return the share of an exposure in which the lamp is on: it goes on at the first edge, off at the next."""
        on = [*self.edges, *([np.inf] if len(self.edges) % 2 else [])]
        spans = zip(on[::2], on[1::2], strict=True)
        return sum(max(min(end, b) - max(begin, a), 0.0) for a, b in spans) / (end - begin)

    def __iter__(self):
        for number, (name, (rate, phase, exposure, offset, drift)) in enumerate(self.words.items()):
            rng = np.random.default_rng(number)
            for k in range(int((self.until - phase) * rate)):
                start = phase + k / rate
                image = rng.normal(60.0, self.noise, (H, W))
                lamp_from = start + 7 * self.row_time_ns * 1e-9
                image[6:9, 10:14] += self.light * self.lit_share(lamp_from, lamp_from + exposure)
                stamp = round((offset + start * (1 + drift)) * 1e9)
                pixels = np.clip(np.round(image), 0, self.full).astype(np.uint16)
                yield Frame(name, k, stamp, round(exposure * 1e9), pixels, row_time_ns=self.row_time_ns)


def offsets(source):
    found = synchronise(source)
    return {one.camera: one for one in found.offsets}, found


def test_exposures_that_fill_the_period_give_microseconds():
    """Clock b is 12.345 s ahead and 40 ppm fast, c 2 ms behind; all run free at rates of their own."""
    source = Filmed(
        {
            "a": (100.0, 0.0, 9.9e-3, 0.0, 0.0),
            "b": (100.0, 3.1e-3, 9.9e-3, 12.345, 40e-6),
            "c": (60.0, 1.7e-3, 16.5e-3, -0.002, 0.0),
        }
    )
    found, result = offsets(source)
    assert result.reference == "a"
    assert result.notes == ()
    middle = EDGES_S.mean()
    for name, offset, drift in (("b", 12.345 + 40e-6 * middle, 40.0), ("c", -0.002, 0.0)):
        one = found[name]
        assert one.edges >= 10
        assert one.offset_s == pytest.approx(offset, abs=max(4 * one.offset_sigma_s, 3e-5))
        assert one.offset_sigma_s < 6e-5
        assert one.drift_ppm == pytest.approx(drift, abs=4 * one.drift_sigma_ppm)
        assert one.drift_sigma_ppm < 120
    assert "b" in result.lines()[0]
    assert "ms ahead of 'a'" in result.lines()[0]


def test_the_stated_uncertainty_holds_the_error():
    misses = []
    for seed in range(30):
        rng = np.random.default_rng([7, seed])
        edges = np.cumsum(rng.uniform(0.05, 0.2, 12))
        offset, phase = rng.uniform(-0.5, 0.5), rng.uniform(0, 0.01)
        words = {"a": (100.0, 0.0, 7e-3, 0.0, 0.0), "b": (100.0, phase, 7e-3, offset, 0.0)}
        one = offsets(Filmed(words, edges, edges[-1] + 0.1))[0]["b"]
        misses.append((one.offset_s - offset) / one.offset_sigma_s)
    assert np.mean(np.abs(misses) < 2) > 0.8
    assert np.max(np.abs(misses)) < 5


def test_short_exposures_know_an_edge_to_the_gap_and_say_so():
    words = {"a": (100.0, 0.0, 9.9e-3, 0.0, 0.0), "b": (100.0, 4e-3, 1e-5, 0.25, 0.0)}
    found, result = offsets(Filmed(words))
    assert found["b"].offset_s == pytest.approx(0.25, abs=4 * found["b"].offset_sigma_s)
    assert found["b"].offset_sigma_s == pytest.approx(0.00999 / np.sqrt(12) / np.sqrt(found["b"].edges), rel=0.5)
    assert any("camera 'b': no edge fell into an exposure" in note and "9.99 ms" in note for note in result.notes)


def test_a_rolling_shutter_is_read_at_the_lamp_s_row():
    words = {"a": (100.0, 0.0, 9.0e-3, 0.0, 0.0), "b": (100.0, 2e-3, 9.0e-3, 0.01, 0.0)}
    found, _ = offsets(Filmed(words, row_time_ns=50_000))
    assert found["b"].offset_s == pytest.approx(0.01, abs=max(4 * found["b"].offset_sigma_s, 5e-5))


def test_a_lamp_that_saturates_tells_whole_frames_only():
    words = {"a": (100.0, 0.0, 9.9e-3, 0.0, 0.0), "b": (100.0, 4e-3, 9.9e-3, 0.25, 0.0)}
    found, result = offsets(Filmed(words, light=20_000.0))
    assert found["b"].offset_s == pytest.approx(0.25, abs=4 * found["b"].offset_sigma_s)
    assert found["b"].offset_sigma_s > 3e-4
    assert len(result.notes) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"light": 0.0}, "camera 'a': no flash seen, the brightest change is"),
        ({"edges": EDGES_S[:1]}, "camera 'a': 1 edges of a flash seen, 2 at least"),
        (
            {"edges": np.arange(0.05, 1.6, 0.1)},
            "fit the reference camera's at more than one place|at irregular times",
        ),
    ],
)
def test_without_a_flash_or_with_an_even_one_it_says_so(change, message):
    words = {"a": (100.0, 0.0, 9.9e-3, 0.0, 0.0), "b": (100.0, 3e-3, 9.9e-3, 0.25, 0.0)}
    with pytest.raises(InputError, match=message):
        synchronise(Filmed(words, **change))


def test_things_that_move_are_no_flash():
    class Moving(Filmed):
        def lit_share(self, begin, end):
            return 0.5 + 0.5 * np.sin(7 * begin)

    with pytest.raises(InputError, match="does so gradually, as things that move do"):
        synchronise(Moving({"a": (100.0, 0.0, 9e-3, 0.0, 0.0), "b": (100.0, 0.0, 9e-3, 0.0, 0.0)}))


def twin(blink, duration_s=1.0):
    """Two cameras that run free, each on a clock of its own, before one still lamp."""
    slant = np.sqrt(0.5)  # the lamp shines upwards: the cameras are above it
    looking = np.array([[1.0, 0, 0], [0, -slant, slant], [0, -slant, -slant]])
    lens = OpenCVLens(150.0, 150.0, 47.5, 35.5)

    def camera(name, x, timing):
        view = Camera(name, 96, 72, lens, Pose(looking, np.array([x, -1.4, 1.4])))
        return VirtualCamera(view, timing=timing, mount=Mount(body_px=0.0), optics=Optics(), sensor=Sensor(bits=12))

    still = Timing(rate_hz=100.0, jitter_s=0.0, clock="device")
    cameras = (
        camera("left", -0.05, still),
        camera("right", 0.05, replace(still, offset_s=2.3e-3, clock_offset_s=7.5, clock_drift_ppm=60.0)),
    )
    scene = build_light_marker(
        duration_s=duration_s,
        box_center_m=np.zeros(3),
        box_size_m=np.full(3, 0.5),
        rng=np.random.default_rng(3),
        speed_mps=1e-4,
        diameter_m=0.04,
        floor=False,
    )
    scene = with_lamps(scene, {"light": blink})
    return TwinSource(scene, cameras, frame_rate_hz=100.0, exposure_s=9e-3, pulses=round(100 * duration_s), seed=1)


def test_the_twin_s_free_running_cameras_are_found_on_their_clocks():
    bits = tuple(bit == "1" for bit in "1011000111010010100110111001")
    with twin(Blink(bits, 0.0313, 0.021)) as source:
        found, result = offsets(source)
    (one,) = found.values()
    assert one.offset_s == pytest.approx(7.5 + 60e-6 * 0.5, abs=max(4 * one.offset_sigma_s, 1e-4))
    assert one.offset_sigma_s < 2e-4
    assert one.edges >= 8
    assert result.reference == "left"


def test_the_twin_s_lamp_that_never_flashes_is_told():
    with (
        pytest.raises(InputError, match=r"no flash seen|does so gradually|edges of a flash seen"),
        twin(None, 0.3) as source,
    ):
        synchronise(source)


def test_rig_check_says_how_cameras_of_a_recording_are_synchronised(tmp_path):
    filmed = Filmed({"a": (100.0, 0.0, 9.9e-3, 0.0, 0.0), "b": (60.0, 3.1e-3, 16.5e-3, 0.25, 0.0)})
    with RecordingWriter(tmp_path / "flashes", filmed.cameras) as writer:
        for frame in filmed:
            writer.write(frame)
    done = CliRunner().invoke(rig_check, ["--flash", str(tmp_path / "flashes")])
    assert done.exit_code == 0, done.output
    told = re.fullmatch(
        r"camera 'b': stamps \+(\S+) \+- (\S+) ms ahead of 'a', drift .*, 12 edges of the flash\n", done.output
    )
    assert told is not None, done.output
    assert float(told[1]) == pytest.approx(250.0, abs=max(4 * float(told[2]), 0.03))
