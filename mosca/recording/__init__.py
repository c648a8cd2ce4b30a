"""Recordings: a FrameSource from disk, and its writer.

``open_recording`` reads what a folder holds: ``recording.mcap`` (written by ``RecordingWriter``), or for each camera
a folder of numbered images or a video, with or without ``frames.csv``. In all of them a missing number is a dropped
frame and shifts no other. A frame that cannot be read is corrupt, with a note that names it, and the run goes on.
"""

from mosca.recording.image_sequence import NumberedRecording
from mosca.recording.mcap_source import McapRecording
from mosca.recording.open import Recording, open_recording
from mosca.recording.pulses import RecordedPulse
from mosca.recording.writer import RecordingWriter

__all__ = ["McapRecording", "NumberedRecording", "RecordedPulse", "Recording", "RecordingWriter", "open_recording"]
