"""Poses in a control loop: a filter that fuses late poses and predicts, estimation of the delay, the delay margin."""
