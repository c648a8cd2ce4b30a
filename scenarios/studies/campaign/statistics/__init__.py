"""Sequential verdicts from numbers that come one by one, with error rates that hold for any number of looks."""
