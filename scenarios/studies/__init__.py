"""Studies of many runs: claims, error budgets, acceptance tests, plans of rigs, benchmarks, certificates."""
