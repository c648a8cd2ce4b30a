"""Initial values: resection, interior orientation, target poses, projective reconstruction."""
