"""Points of consecutive frame sets to tracks: gating, assignment, Kalman filters, rigid neighbours."""
