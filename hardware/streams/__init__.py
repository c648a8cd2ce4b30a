"""Tracked markers and bodies as streams that clients of motion-capture systems read; faults in them on demand."""
