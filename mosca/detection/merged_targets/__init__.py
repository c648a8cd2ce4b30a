"""Two targets whose images touch: fitted together."""
