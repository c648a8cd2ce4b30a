"""Poses in a control loop: a filter that fuses late poses and predicts, the delay from data, the delay margin."""
