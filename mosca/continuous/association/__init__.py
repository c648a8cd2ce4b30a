"""Frames of unsynchronised cameras to image tracks of one marker each."""
