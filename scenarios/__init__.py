"""The only room where everything meets: scenario files, runs, scores, the suite and the command line."""
