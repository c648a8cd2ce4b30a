"""Clocks of cameras compared by a lamp that flashes in all their views."""
