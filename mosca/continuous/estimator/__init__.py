"""Least-squares estimation of continuous-time trajectories, camera clocks and poses."""
