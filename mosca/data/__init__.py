"""The vocabulary: plain read-only data that crosses rooms, and its files."""
