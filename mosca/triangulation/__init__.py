"""Image points of known correspondence to points in space, with covariance."""
