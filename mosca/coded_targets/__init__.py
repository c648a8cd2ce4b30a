"""Coded targets and boards in an image: search, decoding, centres with covariance."""
