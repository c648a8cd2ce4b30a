"""Experiments of the literature as programs."""
