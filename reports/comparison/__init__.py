"""The page that compares runs: what differs first, then figures where they are comparable, plots on one scale."""
