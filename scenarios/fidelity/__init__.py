"""The virtual cameras against outside witnesses: checks, their table, and pictures of each disturbance."""
