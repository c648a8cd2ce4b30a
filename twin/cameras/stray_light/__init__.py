"""Light that does not come from targets: reflections, glare, surroundings."""
