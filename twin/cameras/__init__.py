"""Virtual cameras: shutter, mount, lens, render, sensor, in the order that light takes."""
