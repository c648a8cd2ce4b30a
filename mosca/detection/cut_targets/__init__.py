"""Targets that something in front cuts off along an edge: the centre of the whole disc."""
