"""What an image must be, worked out without any of the project's code: outlines, pixels, rays, noise.

Imports numpy, scipy, OpenCV and MuJoCo, and nothing of the project. Tests and ``mosca twin fidelity`` hold the
virtual cameras against it.
"""
