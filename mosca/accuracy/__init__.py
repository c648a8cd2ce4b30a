"""Accuracy of a rig: predicted for a plan, tested by certified artefacts, and what its cameras themselves err by."""
