"""The twin of a user's lab: cameras of a scenario with parameters estimated from recordings (docs/lab_twin.md)."""
