"""Edits of takes: operations on tracks and on motions, in the order of a file, each undone to the bit."""
