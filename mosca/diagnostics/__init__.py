"""Residual diagnostics of cameras: a noise model for matching, and faults for the operator."""
