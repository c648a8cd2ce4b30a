"""Tracks from points of consecutive frame sets: gating, assignment, Kalman filters, rigid neighbours."""
