"""Light that is no target's: reflections, glare, surroundings."""
