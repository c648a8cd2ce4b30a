"""Work with devices that needs detection, scenarios and hardware together."""
