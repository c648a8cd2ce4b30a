"""Joints and joint angles of people in files: CSV, OpenSim's .mot and scale sets, C3D."""
