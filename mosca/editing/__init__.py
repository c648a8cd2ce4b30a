"""Edits of takes: operations on tracks and on motions, in the order of a file; each can be undone bit for bit."""
