"""Output for people: records, pages, plots, recordings for the viewer."""
