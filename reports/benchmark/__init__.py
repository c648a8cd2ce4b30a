"""The leaderboard of the benchmark."""
