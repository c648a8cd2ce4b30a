"""The second paper's own methods, to compare with: interpolation to common instants, and networks of time."""
