"""A driven body's linear model from files: tracks and commands in, model and picture out."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.bodies import RigidBody
from mosca.data.files.whole_file import check_writable, write_text
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.bodies.body_file import read_bodies
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.machines.identification.commands import CommandRows, read_commands
from mosca.machines.identification.deck import PAPER, in_axes, learned_deck, read_axes
from mosca.machines.identification.held_inputs import HeldInputs
from mosca.machines.identification.identify import (
    IdentifiedModel,
    IdentifiedOutput,
    IdentifySettings,
    fit_on,
    fit_percent,
    identify,
)
from mosca.machines.identification.model_file import write_model
from mosca.machines.identification.velocities import OUTPUTS, UNITS, BodyVelocities, PlanarPath, planar_path
from mosca.rigid_bodies.tracker import body_poses
from reports.identification_plots import DrivenTake, driven_picture
from reports.plot_style import svg_file

Report = Callable[[int, int | None], None]


@dataclass(frozen=True)
class IdentifyOptions:
    """The options of ``mosca identify``, under their names."""

    tracks: Path
    commands: Path
    out: Path | None
    plot: Path | None
    body: Path | None
    axes: str | None
    inputs: str | None
    validate: tuple[Path, Path] | None
    orders: int
    delay: float

    def run(self, progress: Report) -> list[str]:
        """Identify, write the requested files, and return the lines to print; InputError where that is impossible."""
        for path, suffix in ((self.out, ".json"), (self.plot, ".svg")):
            if path is not None:
                if path.suffix.lower() != suffix:
                    raise InputError(f"{path}: suffix '{path.suffix}' given; {suffix} is wanted here")
                check_writable(path)
        files = [(self.tracks, self.commands), *([] if self.validate is None else [self.validate])]
        takes = [(tracks, self._commands(commands), read_tracks(tracks)) for tracks, commands in files]
        deck = self._deck(takes[0][2])
        driven, inputs = self._take(deck, *takes[0])
        settings = IdentifySettings(most_order=self.orders, most_delay_s=self.delay)
        try:
            model = identify(driven, inputs, settings, progress)
        except InputError as error:
            raise InputError(f"{self.tracks}, {self.commands}: {error}") from None
        rate = f"{1 / driven.period_s:.6g} Hz"
        lines = [f"{len(driven.frame)} poses of '{deck.name}' at {rate}, {len(inputs.time_s)} commands"]
        for one in model.outputs:
            lines += described(one, model)
        lines += second_opinion(model)
        shown = _picture(driven, inputs, model.velocities, self._answer(model, driven, inputs), str(self.tracks))
        fits: tuple[float, ...] | None = None
        if self.validate is not None:
            other, given = self._take(deck, *takes[1])
            velocities, answer, fits = fit_on(model, other, given)
            shown = _picture(other, given, velocities, answer, str(self.validate[0]))
            told = ", ".join(f"{name} {fit:.1f} %" for name, fit in zip(OUTPUTS, fits, strict=True))
            lines.append(f"fit on {self.validate[0]}, not seen before: {told}")
        if self.out is not None:
            write_model(model, self.out, fits)
            lines.append(f"model in {self.out}")
        if self.plot is not None:
            write_text(self.plot, svg_file(driven_picture(shown)))
            lines.append(f"commands and answer in {self.plot}")
        return lines

    def _deck(self, tracks: Tracks) -> RigidBody:
        axes = None if self.axes is None else read_axes(self.axes)
        if self.body is None:
            try:
                return learned_deck(tracks, axes or PAPER)
            except InputError as error:
                raise InputError(f"{self.tracks}: {error}") from None
        bodies = read_bodies(self.body)
        if len(bodies) > 1:
            names = ", ".join(one.name for one in bodies)
            raise InputError(f"--body {self.body}: defines {names}; a file with the driven body alone is wanted")
        return bodies[0] if axes is None else in_axes(bodies[0], axes)

    def _commands(self, path: Path) -> CommandRows:
        return read_commands(path, tuple(part.strip() for part in self.inputs.split(",")) if self.inputs else ())

    def _take(
        self, deck: RigidBody, path: Path, commands: CommandRows, tracks: Tracks
    ) -> tuple[PlanarPath, HeldInputs]:
        """Return a take's path, and its commands on the path's clock."""
        planar = planar_path(body_poses(tracks, (deck,)).of(deck.name), str(path))
        return planar, commands.held(int(planar.time_ns[0]), int(planar.frame[0]), planar.period_s)

    def _answer(self, model: IdentifiedModel, path: PlanarPath, inputs: HeldInputs) -> Array:
        return np.asarray(model.response(inputs, path.grid, means=False)[path.frame - path.frame[0]])


def described(one: IdentifiedOutput, model: IdentifiedModel) -> list[str]:
    """Return the lines on the identified model of an output."""
    estimate, n = one.estimate, one.order
    value, half = estimate.quantities, (estimate.intervals[:, 1] - estimate.intervals[:, 0]) / 2
    tried = ", ".join(f"{rms:.3g}" for rms in one.held_out_rms)
    lines = [
        f"{one.name}: order {n}, by the last part of the take (rms of orders 1 to {len(one.held_out_rms)}: {tried} "
        f"{one.unit}); fit there {one.fit_held_out:.1f} %; intervals of 95 % from {estimate.blocks} blocks"
    ]
    for j in range(0, 2 * n, 2):
        z = np.exp((value[j] + 1j * value[j + 1]) * model.period_s)
        turning = f", {value[j + 1]:+.3g} +- {half[j + 1]:.2g} i" if value[j + 1] else ""
        discrete = f"{z.real:.4f}" + (f" {z.imag:+.4f} i" if z.imag else "")
        lines.append(f"  pole {value[j]:.4g} +- {half[j]:.2g}{turning} 1/s; discrete {discrete}")
    for j, name in enumerate(model.inputs):
        lines.append(f"  DC gain of {name}: {value[2 * n + j]:.4g} +- {half[2 * n + j]:.2g} {one.unit} per unit")
    lines.append(f"  delay behind the commands: {1e3 * value[-1]:.3g} +- {1e3 * half[-1]:.2g} ms")
    arx = ", ".join(f"{p.real:.4f}" + (f"{p.imag:+.4f} i" if p.imag else "") for p in one.arx)
    lines.append(f"  ARX of that order, biased by noise: discrete poles {arx}")
    return lines


def second_opinion(model: IdentifiedModel) -> list[str]:
    """Return the line on the eigensystem realization."""
    poles = ", ".join(
        f"{p.real:.4f}" + (f"{p.imag:+.4f} i" if abs(p.imag) > 1e-12 else "")
        for p in sorted(model.realization.poles, key=lambda p: -abs(p))
    )
    return [f"both outputs by eigensystem realization, order {len(model.realization.poles)}: discrete poles {poles}"]


def _picture(
    path: PlanarPath, inputs: HeldInputs, velocities: BodyVelocities, answer: Array, what: str
) -> DrivenTake:
    sigma = np.sqrt(np.diagonal(velocities.covariance, axis1=1, axis2=2))
    time_s = (path.time_ns - path.time_ns[0]) * 1e-9
    fits = fit_percent(velocities.values, answer).tolist()
    measured = velocities.values
    return DrivenTake(
        time_s, measured, sigma, answer, inputs.time_s, inputs.values, inputs.names, OUTPUTS, UNITS, fits, what
    )  # fmt: skip
