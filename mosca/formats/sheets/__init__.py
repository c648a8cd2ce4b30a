"""Printed target sheets, and the scale that a printer gave them."""
