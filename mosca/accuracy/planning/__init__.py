"""Planning of camera places: the predicted covariance of triangulated points, its gradient, and the search."""
