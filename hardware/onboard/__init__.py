"""Commands to robots and what they report, on the session's clock."""
