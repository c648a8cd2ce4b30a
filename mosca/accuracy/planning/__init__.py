"""Where cameras are to stand: the predicted covariance of triangulated points, its gradient, and the search."""
