"""Keys of a scenario file: how the vibration of a panel is analysed."""

from typing import Literal

from pydantic import Field

from mosca.data.files.toml import Positive, Table


class VibrationSpec(Table):
    """``[vibration]``: modes found in the tracks of the scene's panel, and scored against its true ones: mode_*."""

    rigid: Literal["none", "all"] = Field(
        "none", description="'all': the rigid motion of all targets is taken out, as on a carrier that moves"
    )
    segment_s: Positive = Field(8.0, description="length of a segment of the spectra [s]")
