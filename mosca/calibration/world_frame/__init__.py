"""The world frame: L-frame, similarity transformation."""
