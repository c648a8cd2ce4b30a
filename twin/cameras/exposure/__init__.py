"""One exposure: shutter, mount, lighting, the scene at sampled instants."""
