"""The page that compares runs: first the differences, then figures where they are comparable, plots on one scale."""
