"""A virtual camera: a calibrated camera of the rig with the imperfections of a real one."""

from dataclasses import dataclass, field

from mosca.data.rig import Camera
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.sensor.background_light import Backdrop
from twin.cameras.sensor.sensor import Sensor


@dataclass(frozen=True, eq=False)
class VirtualCamera:
    """A calibrated camera of the rig with a real one's effects on light and time, each described in its own file.

    No scenario may soften the defaults of these effects.
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
    """Unevenness of the background, and dust."""
