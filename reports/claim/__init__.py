"""The page of a claim over many runs."""
