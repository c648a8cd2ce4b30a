"""A second scene whose objects are moved by tracked bodies: its objects, and their poses at each display."""
