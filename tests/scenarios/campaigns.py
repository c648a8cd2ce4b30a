"""Randomised campaigns: a rig of emulated cameras, a trigger, and a timetable of faults, all drawn from one seed.

A campaign runs in two processes: ``campaign_emulator.py`` serves the cameras, spoils them by the timetable and
logs each true exposure; ``campaign_run.py`` is ``mosca run --source hardware:``, whose frame sets are written down.
``campaign_check.py`` compares the two. Each image carries its camera and the number of its exposure.
"""

import json
import os
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from campaign_check import Exposure, Outcome, Seen, SeenSet, Truth

SIZE = (128, 96)
EXPOSURE_NS = 1_000_000
TRIGGERS = ("software", "action", "line", "line without stamps")
MOST_FRAMES_HZ = 200
"""Frames a second of all cameras: beyond it the processors of a small machine are what is tested."""
LIMITS = (1.0, 0.95, 0.8, 0.4)
PATIENT_S = 300.0
"""For the programs to begin and to end, however busy the machine is."""
STREAM = 47
"""Of the draws; with this one each trigger meets each fault in 20 seeds."""
_FOLDER = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Event:
    """A fault: what, from when on [s after the first exposure], for how long [s], of which camera ("": all)."""

    what: str
    at_s: float
    for_s: float = 0.0
    camera: str = ""
    share: float = 1.0
    """Of the pulses or packets in that time."""

    def __str__(self) -> str:
        of = f" of {self.camera}" if self.camera else ""
        share = f" ({self.share:.0%})" if self.share < 1 else ""
        return f"{self.what}{of} {self.at_s:.1f}+{self.for_s:.1f} s{share}"


@dataclass(frozen=True)
class Campaign:
    """What is drawn from a seed; ``seconds``: duration."""

    seed: int
    seconds: float
    cameras: tuple[str, ...]
    rate_hz: float
    trigger: str
    wire: str
    """What makes the pulses of a line: the rig's own generator ("serial"), or one that always runs ("external")."""
    limit: float
    events: tuple[Event, ...]
    key: int
    """Of action commands: those of campaigns that run beside this one are not for its cameras."""

    @property
    def pulses(self) -> int:
        return round(self.seconds * self.rate_hz)

    @property
    def stamps(self) -> bool:
        return self.trigger != "line without stamps"

    def __str__(self) -> str:
        wire = f" ({self.wire})" if self.wire else ""
        faults = "; ".join(map(str, self.events))
        return f"seed {self.seed}: {len(self.cameras)} cameras, {self.rate_hz:g} Hz, {self.trigger}{wire}: {faults}"


def drawn(seed: int, seconds: float = 60.0) -> Campaign:
    """Return the campaign of a seed; the faults lie within its duration, with time to see what follows."""
    rng = np.random.default_rng([seed, STREAM])
    trigger = TRIGGERS[seed % len(TRIGGERS)]
    count = int(rng.integers(2, 5))
    cameras = tuple(f"cam{k + 1}" for k in range(count))
    rate = float(rng.choice([r for r in (20, 25, 40, 50, 100) if r * count <= MOST_FRAMES_HZ]))
    wire = str(rng.choice(["serial", "external"])) if trigger.startswith("line") else ""
    kinds = ["kill camera", "withhold", "reboot", "unplug", "late", "packets", "kill rig"]
    wanted = [
        str(k) for k in rng.choice(kinds, int(rng.integers(2, 6)), p=[0.12, 0.17, 0.17, 0.17, 0.15, 0.13, 0.09])
    ]
    # one that ends cameras or rig comes once
    last = [k for k in dict.fromkeys(wanted) if k.startswith("kill")]
    wanted = [k for k in wanted if not k.startswith("kill")]
    events = []
    for k, what in enumerate(wanted):
        at = seconds * (0.05 + 0.75 * (k + float(rng.uniform(0.1, 0.8))) / max(len(wanted), 1))
        of = str(rng.choice(cameras)) if what in ("reboot", "unplug", "packets") or rng.random() < 0.5 else ""
        if what == "late" and trigger.startswith("line"):
            of = ""  # one generator
        longest = {"reboot": 3.0, "unplug": 10.0, "late": 5.0, "withhold": 5.0, "packets": 8.0}[what]
        share = {"late": 0.2, "withhold": 0.3, "packets": 0.2}.get(what, 1.0)
        lasts = float(np.exp(rng.uniform(np.log(0.2), np.log(longest)))) * min(seconds / 60, 1.0)
        events.append(Event(what, at, lasts, of, share))
    for what in last:
        of = str(rng.choice(cameras)) if what == "kill camera" else ""
        events.append(Event(what, seconds * float(rng.uniform(0.2 if of else 0.5, 0.95)), 0.0, of))
    events.sort(key=lambda one: one.at_s)
    limit = float(rng.choice(LIMITS))
    return Campaign(seed, seconds, cameras, rate, trigger, wire, limit, tuple(events), int(rng.integers(2, 2**31)))


def write_files(campaign: Campaign, addresses: dict[str, str], port: str, folder: Path) -> None:
    """Write the rig and the scenario of a campaign."""
    source = {"software": "software", "action": "action"}.get(campaign.trigger, campaign.wire)
    trigger = {"software": "Software", "action": "Action1"}.get(campaign.trigger, "Line1")
    rig = f"[hardware]\nrate_hz = {campaign.rate_hz}\n[hardware.trigger]\nsource = '{source}'\nport = '{port}'\n"
    keys = ""
    if source == "action":
        rig += f"broadcast = '127.255.255.255'\ndevice_key = {campaign.key}\n"
        keys = f"features = {{ ActionDeviceKey = {campaign.key}, ActionGroupKey = 1, ActionGroupMask = 1 }}"
    for name in campaign.cameras:
        rig += textwrap.dedent(f"""
            [[camera]]
            name = "{name}"
            size = [{SIZE[0]}, {SIZE[1]}]
            [camera.hardware]
            driver = "gige"
            address = "{addresses[name]}"
            trigger = "{trigger}"
            exposure_us = {EXPOSURE_NS / 1e3}
            packet_bytes = 4000
            {keys}
            """)
    (folder / "rig.toml").write_text(rig)
    (folder / "campaign.toml").write_text(
        textwrap.dedent(f"""
        title = "campaign"
        [working_space]
        size_m = [1.0, 1.0, 1.0]
        [capture]
        duration_s = {campaign.seconds}
        frame_rate_hz = {campaign.rate_hz}
        [scene]
        kind = "cloud"
        markers = 8
        marker_diameter_m = 0.02
        [cameras]
        count = {len(campaign.cameras)}
        radius_m = 2.0
        height_m = 0.6
        size_px = [{SIZE[0]}, {SIZE[1]}]
        pixel_pitch_mm = 0.04
        [limits]
        sets_complete = {campaign.limit}
        """)
    )


def run(campaign: Campaign, first_address: str, folder: Path) -> tuple[Truth, Outcome]:
    """Run a campaign in ``folder``; return what really was, and what the rig's run told."""
    given = json.dumps([campaign.seed, campaign.seconds])
    command = [sys.executable, str(_FOLDER / "campaign_emulator.py"), given, first_address, str(folder / "truth")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as emulator:
        assert emulator.stdin is not None
        assert emulator.stdout is not None
        try:
            ready = json.loads(emulator.stdout.readline())
            write_files(campaign, ready["addresses"], ready["port"], folder)
            command = [sys.executable, str(_FOLDER / "campaign_run.py"), str(folder / "sets")]
            words = ["run", "campaign.toml", "--source", "hardware:rig.toml", "--out", "out"]
            environment = {**os.environ, "NUMBA_NUM_THREADS": "1"}
            done = subprocess.run(
                [*command, *words],
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                timeout=campaign.seconds + PATIENT_S,
            )
        finally:
            emulator.kill()
    (folder / "stdout").write_text(done.stdout)
    (folder / "stderr").write_text(done.stderr)
    return read_truth(campaign, folder), read_outcome(campaign, folder, done.returncode)


def read_truth(campaign: Campaign, folder: Path) -> Truth:
    """Return what the emulator logged."""
    exposures: dict[str, dict[int, Exposure]] = {name: {} for name in campaign.cameras}
    begin_ns = None
    for line in (folder / "truth").read_text().splitlines():
        row = json.loads(line)
        if "camera" in row:
            exposures[row["camera"]][row["serial"]] = Exposure(row["start_ns"], row["trigger"])
        elif "begin_ns" in row and campaign.wire == "serial":
            begin_ns = row["begin_ns"]
    return Truth(campaign.rate_hz, campaign.pulses, campaign.limit, EXPOSURE_NS, exposures, begin_ns)


def read_outcome(campaign: Campaign, folder: Path, code: int) -> Outcome:
    """Return what the run told and left."""
    sets = []
    path = folder / "sets"
    for line in path.read_text().splitlines() if path.exists() else ():
        pulse, time_ns, frames = json.loads(line)
        sets.append(SeenSet(pulse, time_ns, {name: Seen(*seen) for name, seen in frames.items()}))
    path = folder / "out" / "record.json"
    record = json.loads(path.read_text()) if path.exists() else None
    return Outcome(tuple(sets), record, code, (folder / "stderr").read_text())


def picture(camera: int, serial: int) -> np.ndarray:
    """Return an image, dark for any detector, in each of whose rows its camera and exposure stand."""
    digits = [camera, *((serial >> 3 * k) & 7 for k in range(10))]
    return np.tile(np.repeat(np.array(digits, np.uint8), 8), 2)[: SIZE[0]][None, :].repeat(SIZE[1], 0)


def shown(image: np.ndarray) -> tuple[int, int]:
    """Return camera and exposure of an image; (-1, -1) where it is no image of ``picture``."""
    digits = image[0, :88:8].astype(int)
    serial = sum(int(digit) << 3 * k for k, digit in enumerate(digits[1:]))
    whole = digits.max() < 8 and np.array_equal(image, picture(int(digits[0]), serial))
    return (int(digits[0]), serial) if whole else (-1, -1)
