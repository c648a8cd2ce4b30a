"""Lens models, blur, point spread functions, pixel response."""
