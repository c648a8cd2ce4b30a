"""The camera model: projection, pixel to ray, Jacobians, eccentricity of ball images."""
