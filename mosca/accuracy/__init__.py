"""Accuracy of a rig: prediction for a plan, test by certified artefacts, and the errors of its cameras."""
