"""Campaigns: many runs of one scenario under stated conditions, and the verdict on what is claimed of them."""
