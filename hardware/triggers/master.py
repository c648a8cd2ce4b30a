"""A master camera runs free; its exposures, on an output line, trigger the others."""

from hardware.trigger import External


class MasterTrigger(External):
    """Pulses are the exposures of ``camera``, which is armed last (``hardware.source``)."""

    def __init__(self, camera: str) -> None:
        self.camera = camera
