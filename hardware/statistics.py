"""What became of the buffers of a rig's cameras, and what happened to them, in words; to be read at any time."""

from dataclasses import dataclass, field


@dataclass
class CameraAccount:
    """What became of one camera's buffers: ``whole`` + ``failed`` came; ``overrun`` found no place to wait.

    ``reopened``: how often the device was lost and found; ``relocked``: how often its clock was; ``unreached``,
    ``ignored``: pulses that did not reach it, or came while it could not expose, where its trigger counter tells
    (``hardware.pulse_numbers.trigger_counter``); ``driver``: the driver's own counts.
    """

    whole: int = 0
    failed: int = 0
    overrun: int = 0
    reopened: int = 0
    relocked: int = 0
    unreached: int = 0
    ignored: int = 0
    driver: dict[str, int] = field(default_factory=dict)


@dataclass
class Account:
    """What happened so far; to be read at any time. ``notes``: in words, in the order in which it happened."""

    cameras: dict[str, CameraAccount] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
