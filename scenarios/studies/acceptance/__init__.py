"""Acceptance tests of twins, recordings and takes, and the certificate that holds their results."""
