"""The page of an acceptance test."""
