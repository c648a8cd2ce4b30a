"""Fit of a blurred disc to the pixels of a target."""
