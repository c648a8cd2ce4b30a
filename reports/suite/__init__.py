"""The page of a suite: one row a scenario, with its verdict, its nearest limit and its history."""
