"""Streams of the Lab Streaming Layer (LSL): their channels, and outlets that inlets and LabRecorder find."""
