"""Scenario files: tables, allowed values, keys without effect."""
