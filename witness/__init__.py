"""Reference images, computed without any of the project's code: outlines, pixels, rays, noise.

The package imports numpy, scipy, OpenCV and MuJoCo, and nothing of the project. Tests and ``mosca twin fidelity``
compare the virtual cameras with it.
"""
