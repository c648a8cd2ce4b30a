"""Truth: what really was. Only the twin makes it and only scenarios read it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array, read_only


@dataclass(frozen=True, eq=False)
class Truth:
    """What really was at each pulse.

    ``time_ns`` (t,) the instant that the pulse's positions belong to: its nominal mid-exposure, session
    clock; ``names`` the markers' names (m of them); ``xyz`` (t, m, 3) marker centres in the world [m];
    ``visible`` (t, m, c) share of the marker's disc that camera c could see (0..1; outside the image 0);
    ``cameras`` the cameras' names; ``image_xy_px`` (t, m, c, 2) the marker *centre's* true image, NaN
    where the camera does not see it; ``diameter_px`` (t, m, c) the diameter of the whole disc's image;
    ``exposure_mid_ns`` (t, c) true mid-exposure of each camera's frame.
    """

    time_ns: Array
    names: tuple[str, ...]
    xyz: Array
    visible: Array
    cameras: tuple[str, ...]
    image_xy_px: Array
    diameter_px: Array
    exposure_mid_ns: Array

    def __post_init__(self) -> None:
        t, m, c = len(np.asarray(self.time_ns)), len(self.names), len(self.cameras)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "cameras", tuple(self.cameras))
        object.__setattr__(self, "time_ns", read_only(self.time_ns, (t,), "time_ns", np.int64))
        object.__setattr__(self, "xyz", read_only(self.xyz, (t, m, 3), "xyz"))
        object.__setattr__(self, "visible", read_only(self.visible, (t, m, c), "visible"))
        object.__setattr__(self, "image_xy_px", read_only(self.image_xy_px, (t, m, c, 2), "image_xy_px"))
        object.__setattr__(self, "diameter_px", read_only(self.diameter_px, (t, m, c), "diameter_px"))
        object.__setattr__(
            self, "exposure_mid_ns", read_only(self.exposure_mid_ns, (t, c), "exposure_mid_ns", np.int64)
        )


def write_truth(truth: Truth, path: Path) -> None:
    """Write all fields under their names (numpy .npz, no pickles)."""
    with open(path, "wb") as file:
        fields = {name: np.asarray(getattr(truth, name)) for name in truth.__dataclass_fields__}
        np.savez_compressed(file, allow_pickle=False, **fields)


def read_truth(path: Path) -> Truth:
    """Read what ``write_truth`` wrote."""
    with np.load(path, allow_pickle=False) as fields:
        values = {name: fields[name] for name in Truth.__dataclass_fields__}
    values["names"] = tuple(str(n) for n in values["names"])
    values["cameras"] = tuple(str(n) for n in values["cameras"])
    return Truth(**values)
