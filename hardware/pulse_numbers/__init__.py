"""Which trigger pulse a frame belongs to: stamps, clocks, trigger counters."""
