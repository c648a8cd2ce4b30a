"""The twin's scene of a scenario, and the settings of its pipeline."""

from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mosca.correspondence.match import MatchSettings
from mosca.data.boards import Board
from mosca.data.files.target_file import read_target_file
from mosca.data.files.toml import Table
from mosca.data.targets import ScaleBar
from mosca.data.wands import LFrame, Wand
from mosca.detection.detect import DetectionSettings
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings
from mosca.synchronisation import AssemblySettings
from mosca.tracking.motion_scale import PERSON_SPACE_M, motion_scale
from mosca.tracking.nearest_neighbour import NearestSettings
from mosca.tracking.tracker import TrackSettings
from scenarios.build.worn_lamps import check_no_lamps, worn_lamps
from scenarios.spec.scenario import Scenario
from scenarios.spec.scenes import (
    ActorScene,
    BoardScene,
    CloudScene,
    DroneScene,
    FaceScene,
    FieldScene,
    LFrameScene,
    LightScene,
    OwnScene,
    PanelScene,
    RobotScene,
    ScaleBarScene,
    WandScene,
)
from scenarios.spec.stages import StageTables
from twin.scenes.emission import Glow
from twin.scenes.live_flight import Steering
from twin.scenes.scene import Scene
from twin.streams import rng

MARGIN = 1.15
"""Factor on the working space in which points are searched, so that points at its edge are not lost."""
WORST_SIGMA_M = 0.005
TargetScene = FieldScene | BoardScene | WandScene | ScaleBarScene | LFrameScene | LightScene
T = TypeVar("T")
Volume = tuple[tuple[float, float, float], tuple[float, float, float]]


def build_scene(spec: Scenario, folder: Path, pilot: Steering | None = None) -> Scene:
    """Return the scene; the scenario's file names are relative to ``folder``. ``pilot``: pilot of a drone."""
    made = _subject(spec, folder, pilot)
    glow_keys = {} if spec.glow is None else spec.glow.model_dump(exclude_unset=True)
    if glow_keys:
        glows = {name: replace(made.glows.get(name, Glow()), **glow_keys) for name in made.marker_names}
        made = replace(made, glows=glows)
    if spec.lamps is not None:
        if glow_keys.get("kind", "lamp") != "lamp" and spec.lamps.names is None:
            raise InputError(
                f"glow.kind = '{glow_keys['kind']}' with [lamps]: all markers are lamps; leave the kind out"
            )
        from twin.scenes.target_lamps import LAMP, with_numbered_lamps

        made = with_numbered_lamps(
            made,
            spec.capture.frame_rate_hz,
            names=spec.lamps.names,
            frames_per_bit=spec.lamps.frames_per_bit,
            glow=replace(LAMP, **{**glow_keys, "kind": "lamp"}),
        )
    return made


def _subject(spec: Scenario, folder: Path, pilot: Steering | None) -> Scene:
    scene = spec.scene
    space = spec.working_space
    where: dict[str, Any] = {
        "duration_s": spec.capture.duration_s,
        "box_center_m": np.array(space.center_m),
        "box_size_m": np.array(space.size_m),
        "rng": rng(spec.seed, "scene"),
    }
    if isinstance(scene, ActorScene):
        from twin.scenes.actor import build_actor

        motion: dict[str, Any] = {
            name: None if given is None else beside(given, folder)
            for name, given in (("motion_file", scene.motion), ("skeleton_file", scene.skeleton))
        }
        rest = scene.model_dump(exclude={"kind", "motion", "skeleton", "motion_rate_hz"})
        return build_actor(**where, **motion, **rest, frame_rate_hz=scene.motion_rate_hz, lamps=worn_lamps(spec))
    check_no_lamps(spec)
    if isinstance(scene, FaceScene):
        from twin.scenes.face import build_face

        return build_face(**where, **scene.model_dump(exclude={"kind"}))
    if isinstance(scene, DroneScene):
        if spec.self_orientation is not None:
            from scenarios.build.survey import survey_scene

            return survey_scene(spec)
        from twin.scenes.drone import build_drone

        return build_drone(**where, **scene.model_dump(exclude={"kind"}), pilot=pilot).scene
    if isinstance(scene, RobotScene):
        from scenarios.build.robot_commands import command_lines
        from twin.scenes.robot import build_robot

        return build_robot(
            **where,
            average_pwm=scene.average_pwm,
            difference_pwm=scene.difference_pwm,
            target_diameter_m=scene.marker_diameter_m,
            commands=None if scene.commands is None else command_lines(beside(scene.commands, folder), scene.target),
            heading_rad=None if scene.heading_deg is None else np.deg2rad(scene.heading_deg),
        )
    if isinstance(scene, CloudScene):
        from twin.scenes.cloud import build_cloud

        return build_cloud(
            **where, n=scene.markers, marker_diameter_m=scene.marker_diameter_m, speed_mps=scene.speed_mps
        )
    if isinstance(scene, PanelScene):
        return _panel(scene, where)
    if not isinstance(scene, OwnScene):
        return _target(scene, where, folder)
    from twin.scenes.user_markers import MarkersInModel
    from twin.scenes.user_model import build_own

    markers = MarkersInModel.of_words(scene.markers) or beside(scene.markers, folder)
    files: dict[str, Any] = {"model_file": beside(scene.model, folder), "markers_file": markers}
    if scene.motion == "turntable":
        return build_own(**where, **files, motion="turntable", speed_mps=scene.speed_mps)
    if scene.motion == "physics":
        return build_own(**where, **files, motion="physics")
    return build_own(**where, **files, motion="table", motion_file=beside(scene.motion, folder))


def _panel(scene: PanelScene, where: dict[str, Any]) -> Scene:
    from twin.scenes.panel import build_panel
    from twin.scenes.plate import ThinPlate

    rest = scene.model_dump(
        exclude={"kind", "thickness_m", "youngs_pa", "poisson", "density_kg_m3", "marker_diameter_m"}
    )
    plate = ThinPlate(scene.size_m, scene.thickness_m, scene.youngs_pa, scene.poisson, scene.density_kg_m3)
    return build_panel(**where, **rest, plate=plate, target_diameter_m=scene.marker_diameter_m)


def _target(scene: TargetScene, where: dict[str, Any], folder: Path) -> Scene:
    """Return the scene of a calibration target."""
    if isinstance(scene, LightScene):
        from twin.scenes.target_lamps import build_light_marker

        rest = scene.model_dump(exclude={"kind", "marker_diameter_m"})
        return build_light_marker(**where, **rest, diameter_m=scene.marker_diameter_m)
    file = None if scene.target is None else beside(scene.target, folder)
    if isinstance(scene, FieldScene):
        from twin.scenes.target_field import build_field

        return build_field(
            **where,
            n=scene.markers,
            layout=scene.layout,
            dot_radius_m=scene.dot_radius_m,
            target_file=file,
            turn_rad_s=np.deg2rad(scene.turn_deg_per_s),
        )
    if isinstance(scene, BoardScene):
        from twin.scenes.target_boards import build_board

        return build_board(
            **where,
            board=_described(file, Board),
            speed_mps=scene.speed_mps,
            turn_rad_s=np.deg2rad(scene.turn_deg_per_s),
            facing=scene.facing,
            tilt_rad=np.deg2rad(scene.tilt_deg),
        )
    from twin.scenes.target_wand import build_l_frame, build_scale_bar, build_wand

    if isinstance(scene, LFrameScene):
        del where["rng"]
        return build_l_frame(**where, l_frame=_described(file, LFrame), azimuth_rad=np.deg2rad(scene.azimuth_deg))
    speed: dict[str, Any] = {"speed_mps": scene.speed_mps, "turn_rad_s": np.deg2rad(scene.turn_deg_per_s)}
    if isinstance(scene, WandScene):
        return build_wand(**where, wand=_described(file, Wand), **speed)
    return build_scale_bar(**where, bar=_described(file, ScaleBar), **speed)


def _described(file: Path | None, kind: type[T]) -> T | None:
    """Return the target in a file; InputError where it is of another kind."""
    if file is None:
        return None
    target = read_target_file(file)
    if not isinstance(target, kind):
        raise InputError(f"{file}: describes a {type(target).__name__}; a {kind.__name__} is wanted")
    return target


def pipeline_settings(spec: Scenario) -> PipelineSettings:
    """Return the pipeline's settings: its defaults, the scenario's differences, and the volume of possible points."""
    centre, size = np.array(spec.working_space.center_m), np.array(spec.working_space.size_m)
    low, high = centre - MARGIN * size / 2, centre + MARGIN * size / 2
    # each zone is tracked separately: its targets move as in a space of the zone's size, not of the whole hall
    edge_m = max((max(zone.size_m) for zone in spec.zone), default=None)
    box = ((low[0], low[1], low[2]), (high[0], high[1], high[2]))
    settings = stage_settings(spec.pipeline, box, edge_m)
    if spec.pipeline.step_by == "pulse":
        settings = replace(settings, assembly=AssemblySettings(nominal_times=True))
    if spec.flight is not None:
        settings = replace(settings, lookahead=0)
    if spec.pipeline.tracker == "nearest":
        return replace(settings, nearest=NearestSettings(motion_scale(settings.track).gate_m, settings.track.coast_s))
    return settings


def stage_settings(stages: StageTables, volume: Volume | None, edge_m: float | None = None) -> PipelineSettings:
    """Return the pipeline's defaults overridden by the tables detection, match and track of ``stages``.

    The tracker's lengths and speeds follow from the volume's longest edge; without a volume the pipeline estimates
    them. Points with an uncertainty above 0.2 % of that edge are withheld. ``edge_m``: that edge, where it is not the
    one of the volume.
    """
    track, match = TrackSettings(), MatchSettings()
    if volume is not None:
        longest = max(high - low for low, high in zip(*volume, strict=True)) / MARGIN
        edge_m = longest if edge_m is None else edge_m
        track = replace(track, **motion_scale(track, edge_m)._asdict())
        match = replace(match, worst_sigma_m=WORST_SIGMA_M * edge_m / PERSON_SPACE_M)
    return PipelineSettings(
        replace(DetectionSettings(), **_given(stages.detection)),
        replace(match, **_given(stages.match)),
        replace(track, **_given(stages.track)),
        volume,
    )


def _given(table: Table) -> dict[str, Any]:
    return {name: value for name, value in table.model_dump().items() if value is not None}


def beside(name: str, folder: Path) -> Path:
    """Return the file that a scenario in ``folder`` names."""
    path = Path(name)
    return path if path.is_absolute() else folder / path
