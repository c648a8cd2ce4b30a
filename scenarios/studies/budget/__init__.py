"""Error budgets: contribution of each source of error, by switching sources off."""
