"""The twin of one's own lab: cameras of a scenario with parameters estimated from recordings (docs/lab_twin.md)."""
