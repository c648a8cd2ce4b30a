"""Points in space, with covariance, from image points of known correspondence."""
