"""The second paper's own methods, for comparison: interpolation to common instants, and networks of time."""
