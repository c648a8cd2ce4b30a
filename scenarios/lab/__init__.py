"""Where devices meet the rest: what needs detection, scenarios and hardware at once."""
