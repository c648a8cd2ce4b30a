"""A virtual camera: the calibrated camera of the rig with everything that makes a real one."""

from dataclasses import dataclass, field

from mosca.data.rig import Camera
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.sensor.background_light import Backdrop
from twin.cameras.sensor.sensor import Sensor


@dataclass(frozen=True, eq=False)
class VirtualCamera:
    """A calibrated camera of the rig with what a real one does to light and time, each described in its own file.

    The defaults of all are those that no scenario may soften.
    """

    camera: Camera
    """The true geometry."""
    optics: Optics = field(default_factory=Optics)
    timing: Timing = field(default_factory=Timing)
    mount: Mount = field(default_factory=Mount)
    sensor: Sensor = field(default_factory=Sensor)
    marker_signal: float = 0.6
    """Light that a pixel fully covered by a marker collects, over the saturation capacity."""
    backdrop: Backdrop = field(default_factory=Backdrop)
    """What is uneven behind the targets."""
