"""Planned rigs from plan files, with scenario and verification."""
