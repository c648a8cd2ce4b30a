"""Frames to image points with covariance: background, threshold regions, centroid or disc fit."""
