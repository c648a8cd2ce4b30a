"""All scenarios: catalogue, parallel runs, regressions against baselines."""
