"""The page of a suite: one row for each scenario, with its verdict, its nearest limit and its history."""
