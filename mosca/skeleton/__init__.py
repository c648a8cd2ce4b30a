"""Skeletons of people: a model fitted to a take, poses and joints with covariances, joint angles, gait events."""
