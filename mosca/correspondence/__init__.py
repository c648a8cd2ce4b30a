"""Data association between cameras: which image points show the same marker."""
