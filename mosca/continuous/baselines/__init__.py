"""Methods of the literature, to compare with: linear and spline interpolation, neural trajectories."""
