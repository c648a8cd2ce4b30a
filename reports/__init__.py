"""What people read: records, pages, plots, recordings for the viewer."""
