"""Description files of calibration objects: the tables of each kind, and the objects they define.

::

    kind = "field"                        # targets at known positions, in the field's own axes
    dot_radius_m = 0.008                  # ring_inner_m, ring_outer_m and plate_m: 2, 3 and 8 times that
    sigma_m = 0.00002
    [[target]]
    number = 17                           # coded; without a number: a plain disc of plain_radius_m
    position_m = [0.1, 0.0, 0.35]
    normal = [0.0, 1.0, 0.0]              # x_axis where it is not level

    kind = "board"                        # columns and rows count squares, the upper left one is black
    columns = 9
    rows = 6
    square_m = 0.04
    margin_m = 0.04
    marker_m = 0.03                       # with dictionary = "DICT_5X5_50": ChArUco
    inverted = true                       # black and white exchanged; from_behind = true: seen from both sides

    kind = "wand"
    along_m = [0.0, 0.15, 0.5]            # the balls' centres on it
    diameter_m = 0.014
    [points]                              # for a table of image points (EasyWand, DLTdv, Argus) instead of images
    y_axis = "up"                         # its origin is at the images' lower left
    size_px = [1280, 1024]

    kind = "light"                        # one light that was waved, as for MultiCamSelfCal's points.dat
    between = ["left", "right"]           # cameras whose centres are apart_m apart; without them: no scale
    apart_m = 2.31

    kind = "l_frame"                      # these balls define the world's axes
    diameter_m = 0.014
    [[marker]]
    name = "origin"
    position_m = [0.0, 0.0, 0.0]

    kind = "scale_bar"
    length_m = 1.00012
    sigma_m = 0.000005
    numbers = [3, 4]                      # coded ends of dot_radius_m; or ball_diameter_m; or round_radius_m
    dot_radius_m = 0.008
"""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from mosca.data.boards import Board
from mosca.data.files.toml import Table
from mosca.data.target_codes import NUMBERS
from mosca.data.targets import (
    PLATE,
    RING_INNER,
    RING_OUTER,
    BallTarget,
    CodedTarget,
    PlacedTarget,
    RoundTarget,
    ScaleBar,
    Target,
    TestField,
)
from mosca.data.wands import LFrame, SingleLight, Wand

FARTHEST_M = 1000.0
"""A position farther from the origin than this is taken to be in millimetres."""

Length = Annotated[float, Field(gt=0, le=FARTHEST_M)]
Sigma = Annotated[float, Field(ge=0, le=1.0, description="standard deviation [m]")]
"""A stated standard deviation [m]; above 1 m it is taken to be in another unit."""
Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
Place = tuple[Coordinate, Coordinate, Coordinate]
Number = Annotated[int, Field(ge=0, lt=NUMBERS)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_./-]*$", description="letters, digits, _ . / -")]

Size = tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
PixelOrigin = Literal["centre", "corner", "one"]
PIXEL_ORIGINS = {"centre": 0.0, "corner": 0.5, "one": 1.0}
"""Coordinates of the first pixel's centre under each convention that a file may state."""
MOST_CAMERAS = 1000

CalibrationTarget = TestField | Board | Wand | SingleLight | LFrame | ScaleBar


class FieldTargetTable(Table):
    """``[[target]]``: coded where it has a ``number``, else a plain disc."""

    number: Number | None = Field(None, description="number of a coded target; none: a plain disc")
    name: Name | None = Field(None, description="default: code/NUMBER or round/ROW")
    position_m: Place = Field(description="[x, y, z] of the centre in the field's axes")
    normal: Place = Field((0.0, 0.0, 1.0), description="where its face looks, the field's axes")
    x_axis: Place | None = Field(None, description="to the right on its face; default: level")


class FieldTable(Table):
    """``kind = "field"``: all coded targets have one size; by default a plain disc has that of the dots."""

    kind: Literal["field"]
    dot_radius_m: Length = Field(description="radius of the coded targets' centre dots")
    ring_inner_m: Length | None = Field(
        None, description="inner radius of the code ring [m]; default: twice dot_radius_m"
    )
    ring_outer_m: Length | None = Field(
        None, description="outer radius of the code ring [m]; default: three times dot_radius_m"
    )
    plate_m: Length | None = Field(None, description="edge of the black plate [m]; default: eight times dot_radius_m")
    plain_radius_m: Length | None = Field(None, description="radius of plain discs [m]; default: dot_radius_m")
    sigma_m: Sigma = 0.0
    target: Annotated[tuple[FieldTargetTable, ...], Field(min_length=1, description="[[target]] tables")]

    def made(self) -> TestField:
        """Return the field; ValueError for what does not fit together."""
        return TestField(tuple(self._placed(k) for k in range(len(self.target))), self.sigma_m)

    def _placed(self, k: int) -> PlacedTarget:
        table, dot = self.target[k], self.dot_radius_m
        target: Target
        if table.number is None:
            target, name = RoundTarget(self.plain_radius_m or dot), f"round/{k + 1:03d}"
        else:
            target = CodedTarget(
                table.number,
                dot,
                self.ring_inner_m or RING_INNER * dot,
                self.ring_outer_m or RING_OUTER * dot,
                self.plate_m or PLATE * dot,
            )
            name = target.name
        try:
            return PlacedTarget(
                table.name or name,
                target,
                np.array(table.position_m),
                np.array(table.normal),
                None if table.x_axis is None else np.array(table.x_axis),
            )
        except ValueError as error:
            raise ValueError(f"key 'target[{k}]': {error}") from None


class BoardTable(Table):
    """``kind = "board"``: a checkerboard; with ``marker_m`` and ``dictionary`` a ChArUco board."""

    kind: Literal["board"]
    columns: Annotated[int, Field(ge=3, le=200, description="squares from left to right")]
    rows: Annotated[int, Field(ge=3, le=200, description="squares from top to bottom")]
    square_m: Length = Field(description="edge of a square")
    margin_m: Annotated[float, Field(ge=0, le=FARTHEST_M)] | None = Field(
        None, description="white around the squares [m]; default: square_m"
    )
    marker_m: Length | None = Field(None, description="ChArUco: edge of a marker [m]")
    dictionary: str | None = Field(
        None, description="ChArUco: OpenCV's name of the markers' dictionary, for example DICT_5X5_50"
    )
    sigma_m: Sigma = 0.0
    inverted: bool = Field(False, description="black and white are exchanged, margin included")
    from_behind: bool = Field(False, description="its mirror image is seen on the other side, at the same corners")

    def made(self) -> Board:
        """Return the board; ValueError for one that is symmetric under rotation."""
        margin = self.square_m if self.margin_m is None else self.margin_m
        return Board(
            self.columns,
            self.rows,
            self.square_m,
            margin,
            self.marker_m,
            self.dictionary,
            self.sigma_m,
            self.inverted,
            self.from_behind,
        )


class WandPointsCamera(Table):
    """``[[points.camera]]``: a camera of a table of image points; its size defaults to ``size_px`` of the table."""

    name: Name
    size_px: Size | None = Field(None, description="[width, height] of its images; default: the table's")


class WandPointsTable(Table):
    """``[points]`` of a wand: how the table counts pixels that holds its image points.

    ``y_axis``: "up" from the image's lower left, "down" from its upper left; ``pixel_origin``: what (0, 0) is there,
    "centre" or "corner" of the first pixel, or "one": its centre is (1, 1); ``sigma_px``: standard deviation of a
    coordinate.
    """

    y_axis: Literal["up", "down"] = Field(description='"up": origin at the lower left; "down": at the upper left')
    pixel_origin: PixelOrigin = Field(
        "one", description="what (0, 0) is: the first pixel's centre or corner; 'one': its centre is (1, 1)"
    )
    sigma_px: Annotated[float, Field(gt=0, le=100, description="standard deviation of a coordinate")] = 1.0
    size_px: Size | None = Field(None, description="[width, height] of all images")
    camera: Annotated[tuple[WandPointsCamera, ...], Field(max_length=MOST_CAMERAS)] = Field(
        (), description="cameras in the order of the columns; [[points.camera]]"
    )

    @model_validator(mode="after")
    def _complete(self) -> "WandPointsTable":
        names = [one.name for one in self.camera]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"camera name '{name}' stands twice; give each camera its own name")
        if self.size_px is None and (not names or any(one.size_px is None for one in self.camera)):
            raise ValueError("no 'size_px'; give [width, height] of the images")
        return self


class WandTable(Table):
    """``kind = "wand"``: balls of one size on a line."""

    kind: Literal["wand"]
    along_m: Annotated[
        tuple[Coordinate, ...], Field(min_length=2, max_length=20, description="the balls' places on the line")
    ]
    diameter_m: Length = Field(description="diameter of the balls")
    sigma_m: Sigma = 0.0
    points: WandPointsTable | None = Field(None, description="how a table of its image points counts pixels")

    def made(self) -> Wand:
        """Return the wand; ValueError where balls would touch."""
        return Wand(self.along_m, self.diameter_m, self.sigma_m)


class LightTable(Table):
    """``kind = "light"``: one small light; its image points come as a table."""

    kind: Literal["light"]
    between: tuple[Name, Name] | None = Field(None, description="two cameras whose distance is known")
    apart_m: Length | None = Field(None, description="distance of their centres of projection")
    sigma_px: Annotated[float, Field(gt=0, le=100, description="standard deviation of a coordinate")] = 1.0
    pixel_origin: PixelOrigin = Field("centre", description="what (0, 0) is in the table of image points")

    def made(self) -> SingleLight:
        """Return the light; ValueError where half of its scale is missing."""
        if (self.between is None) != (self.apart_m is None):
            raise ValueError("'between' and 'apart_m' go together: two cameras and the distance of their centres")
        if self.between is not None and self.between[0] == self.between[1]:
            raise ValueError(f"between = {list(self.between)}: two different cameras are wanted")
        return SingleLight(self.between, self.apart_m or 1.0, self.sigma_px, self.pixel_origin)


class FrameMarkerTable(Table):
    """``[[marker]]``: one ball of an L-frame."""

    name: Name
    position_m: Place = Field(description="[x, y, z] of the ball's centre in the world")


class LFrameTable(Table):
    """``kind = "l_frame"``: balls at known positions in the world."""

    kind: Literal["l_frame"]
    diameter_m: Length = Field(description="diameter of the balls")
    sigma_m: Sigma = 0.0
    marker: Annotated[tuple[FrameMarkerTable, ...], Field(min_length=3, max_length=6, description="[[marker]]")]

    def made(self) -> LFrame:
        """Return the frame; ValueError where it leaves the axes open."""
        places = np.array([one.position_m for one in self.marker])
        return LFrame(tuple(one.name for one in self.marker), places, self.diameter_m, self.sigma_m)


class ScaleBarTable(Table):
    """``kind = "scale_bar"``: two equal targets at a certified distance."""

    kind: Literal["scale_bar"]
    length_m: Length = Field(description="certified distance of the centres")
    sigma_m: Sigma
    numbers: tuple[Number, Number] | None = Field(None, description="numbers of coded ends")
    dot_radius_m: Length | None = Field(None, description="coded ends: radius of the centre dots [m]")
    round_radius_m: Length | None = Field(None, description="ends that are plain discs: their radius [m]")
    ball_diameter_m: Length | None = Field(None, description="ends that are balls: their diameter [m]")

    def made(self) -> ScaleBar:
        """Return the bar; ValueError where its ends are missing or given twice."""
        sizes = (self.dot_radius_m, self.round_radius_m, self.ball_diameter_m)
        if sum(size is not None for size in sizes) != 1:
            raise ValueError("give one of 'dot_radius_m' (with 'numbers'), 'round_radius_m', 'ball_diameter_m'")
        if (self.numbers is None) != (self.dot_radius_m is None):
            raise ValueError("'numbers' and 'dot_radius_m' go together: coded targets at both ends")
        if self.numbers is not None and self.dot_radius_m is not None:
            one, two = (CodedTarget.of_dot(number, self.dot_radius_m) for number in self.numbers)
            return ScaleBar(self.length_m, self.sigma_m, (one, two))
        end: Target = (
            RoundTarget(self.round_radius_m) if self.round_radius_m else BallTarget(self.ball_diameter_m or 0.0)
        )
        return ScaleBar(self.length_m, self.sigma_m, (end, end))


CalibrationTable = FieldTable | BoardTable | WandTable | LightTable | LFrameTable | ScaleBarTable
TABLES: dict[str, type[CalibrationTable]] = {
    "field": FieldTable,
    "board": BoardTable,
    "wand": WandTable,
    "light": LightTable,
    "l_frame": LFrameTable,
    "scale_bar": ScaleBarTable,
}
