"""Self-calibration from unknown points: view graph, incremental reconstruction."""
