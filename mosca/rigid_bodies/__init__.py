"""Poses of rigid bodies from their markers: search, tracking, ambiguity, learning of a body."""
