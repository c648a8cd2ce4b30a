"""Campaigns: many runs of one scenario under stated conditions, and the verdict on claims about them."""
