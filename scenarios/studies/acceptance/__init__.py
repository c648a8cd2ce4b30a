"""Acceptance tests of twins, recordings and takes."""
