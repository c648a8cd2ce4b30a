"""Verdicts from numbers that come one by one, with error rates that hold however often they are looked at."""
