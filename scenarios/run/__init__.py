"""One scenario from source to record."""
