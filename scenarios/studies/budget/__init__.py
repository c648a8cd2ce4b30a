"""Error budgets: which source of error costs what, by switching sources off."""
