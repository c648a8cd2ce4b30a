"""Flights in a closed loop: a drone that is steered by the poses that its cameras give."""
