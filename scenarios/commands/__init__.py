"""The work of the verbs, without the command line."""
