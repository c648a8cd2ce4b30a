"""Commands that drive a subject, as timed lines of text: from a program file, or from a recording.

``mosca capture --program`` sends a program (``hardware.onboard.commands``) to a robot; the same program drives the
robot of the twin. The commands kept in a recording drive the twin as they were really sent.
"""

import json
from pathlib import Path
from typing import Any

from hardware.onboard.commands import read_program
from mosca.errors import InputError
from mosca.recording import McapRecording, RecordingWriter, open_recording

CHANNEL = "commands"
Lines = list[tuple[int, str]]


def command_lines(path: Path, target: str) -> Lines:
    """Return the commands to ``target`` in the program file or recording at ``path``: session time [ns], line.

    Raises InputError where there are none.
    """
    if path.is_file() and not path.name.endswith((".mcap", ".mcap.part")):
        program = read_program(path)
        named = [table.name for table in program.target]
        found = [(round(c.at_s * 1e9), line_of(c.command)) for c in program.program if c.target == target]
    else:
        recorded = _recorded(path)
        named = sorted({str(data.get("target")) for _, data in recorded})
        found = [(t, line_of(data["command"])) for t, data in recorded if data.get("target") == target]
    if not found:
        raise InputError(f"{path}: no command for target '{target}'; it has targets {', '.join(named) or '(none)'}")
    return sorted(found, key=lambda one: one[0])


def line_of(command: str | dict[str, Any]) -> str:
    """Return the line that is sent for a command: a text unchanged, a table as JSON."""
    return command if isinstance(command, str) else json.dumps(command)


def write_commands(writer: RecordingWriter, commands: Any, target: str = "robot") -> None:
    """Write the commands of a twin's subject (``twin.scenes.scene.Commands``, pwm_left and pwm_right) as a channel.

    The messages are those that a capture writes for the program it sends. Other commands become an object of their
    values by name.
    """
    for time_ns, values in zip(commands.time_ns, commands.values, strict=True):
        named = dict(zip(commands.names, (float(v) for v in values), strict=True))
        sides = {side: named[f"pwm_{side}"] for side in ("left", "right") if f"pwm_{side}" in named}
        message = {"time_ns": int(time_ns), "target": target, "at_s": time_ns / 1e9, "command": sides or named}
        writer.write_channel(CHANNEL, int(time_ns), message)


def _recorded(path: Path) -> list[tuple[int, dict[str, Any]]]:
    with open_recording(path) as recording:
        if not isinstance(recording, McapRecording):
            raise InputError(
                f"{path}: images and videos hold no commands; a recording.mcap or a program.toml is wanted"
            )
        recorded = list(recording.channel(CHANNEL))
    return [
        (t, data) for t, data in recorded if isinstance(data, dict) and isinstance(data.get("command"), str | dict)
    ]
