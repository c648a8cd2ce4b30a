"""Named random streams from the one seed of a run.

A stream is named by its use ("camera/left/body"), so that a new noise source does not change the others, and by the
pulse to which it belongs, so that the order of work and the number of workers change nothing.
"""

import hashlib

import numpy as np


def key(seed: int, name: str, index: int = 0) -> int:
    """Return the 64-bit key of a stream: for compiled kernels that count their own random numbers."""
    text = f"{seed}/{name}/{index}".encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little")


def rng(seed: int, name: str, index: int = 0) -> np.random.Generator:
    """Return the generator of a stream (PCG64, seeded by its key)."""
    return np.random.Generator(np.random.PCG64(key(seed, name, index)))
