"""Scenes: what moves, where its markers are, and what hides them."""
