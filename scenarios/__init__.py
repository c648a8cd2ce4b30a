"""The package that uses all others: scenario files, runs, scores, the suite and the command line."""
