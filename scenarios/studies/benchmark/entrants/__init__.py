"""Adapters: each a script that runs in its entrant's own environment and imports nothing of this project."""
