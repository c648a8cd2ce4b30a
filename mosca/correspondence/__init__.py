"""Image points of several cameras to groups that show the same marker."""
