"""Recordings: a FrameSource from disk, and its writer.

``open_recording`` reads, by what a folder holds: ``recording.mcap`` (written by ``RecordingWriter``), a
folder of numbered images a camera, or a video a camera, each with or without ``frames.csv``. In all of them a
missing number is a dropped frame, never a shift; what cannot be read is a corrupt frame with a note that
names it, and the run goes on.
"""

from mosca.recording.image_sequence import NumberedRecording
from mosca.recording.mcap_source import McapRecording
from mosca.recording.open import Recording, open_recording
from mosca.recording.pulses import RecordedPulse
from mosca.recording.writer import RecordingWriter

__all__ = ["McapRecording", "NumberedRecording", "RecordedPulse", "Recording", "RecordingWriter", "open_recording"]
