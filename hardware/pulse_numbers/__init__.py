"""Trigger pulse numbers of frames, from time stamps, clocks, trigger counters."""
