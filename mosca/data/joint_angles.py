"""Joint angles of a subject over time, with standard deviations."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only


@dataclass(frozen=True, eq=False)
class JointAngles:
    """Named angles (a of them) at n instants; ``mosca.skeleton.isb_angles`` defines the names."""

    frame: Array
    """(n,) pulse number."""
    time_ns: Array
    """(n,) mid-exposure."""
    names: tuple[str, ...]
    """(a) distinct, such as ``l_hip_flexion``."""
    angles: Array
    """(n, a) [rad], continuous over time, without jumps of a turn; NaN where unknown."""
    sigma: Array
    """(n, a) standard deviation [rad]; NaN where unknown."""

    def __post_init__(self) -> None:
        n, a = len(np.asarray(self.frame)), len(self.names)
        object.__setattr__(self, "names", tuple(self.names))
        set_read_only(self, np.int64, frame=(n,), time_ns=(n,))
        set_read_only(self, angles=(n, a), sigma=(n, a))
        if len(set(self.names)) < a:
            raise ValueError(f"joint angles: {len(set(self.names))} names for {a} angles; each has one of its own")

    def __len__(self) -> int:
        return len(self.frame)
