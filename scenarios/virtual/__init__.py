"""A second scene that tracked bodies move: its objects, and where they are at each display."""
