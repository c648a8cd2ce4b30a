"""Flights in closed loop: a drone steered by the poses that the cameras measure."""
