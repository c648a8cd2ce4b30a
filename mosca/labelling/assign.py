"""Labels for tracks: assigns tracks to the markers of a model by the distances between tracks.

A beam search names the tracks of the stretch that shows most. One marker after another, each with many firm links to
those before, is given every track or none, and the cheapest assignments are kept (Lowerre 1976). A link's cost is the
mean squared deviation of its distance in units of the model's variance, bounded, so that one wrong track does not
decide. A marker that differs between assignments of about the same cost gets no track. Tracks that begin or end
elsewhere are then named by their distances from named tracks.
"""

from dataclasses import replace

import numpy as np
from pydantic import NonNegativeInt, PositiveInt
from pydantic.dataclasses import dataclass

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, NotNegative, Positive
from mosca.data.tracks import Tracks
from mosca.labelling.marker_model import MarkerModel

TIGHTEST = 4
"""Number of links that are averaged; the others depend on each other and are weighted by the root of their number."""
LINKS = 12
LEAST_FIRM = 2
"""Least firm links (within a limb) that a marker's name is based on (all where the model has fewer)."""
NEUTRAL = 1.0
"""Mean cost of a correct link, and cost of an unknown one."""


@dataclass(frozen=True, config=SETTINGS)
class LabelSettings:
    """Costs of assignments, in units of a distance's variance."""

    beam: PositiveInt = 400
    """Assignments kept at each step."""
    bound: Positive = 25.0
    """Largest cost of one link."""
    missing: NotNegative = 10.0
    """Cost of a marker without a track."""
    wrong_side: NotNegative = 12.0
    """Cost of four markers that are mirrored."""
    margin: NotNegative = 5.0
    """Assignments whose costs differ by less are equally good."""
    window: NonNegativeInt = 50
    """Frames on either side of the fullest that are used."""
    least_samples: PositiveInt = 5
    """Samples of a track that is labelled, at least."""
    noise_m: NotNegative = 0.001
    """Standard deviation of a measured distance."""


DEFAULTS = LabelSettings()


def label_tracks(tracks: Tracks, model: MarkerModel, settings: LabelSettings = DEFAULTS) -> Tracks:
    """Return ``tracks`` with the model's names as labels; ambiguous tracks, and those of no marker, keep theirs.

    A track keeps one label over all its frames; no two tracks have the same label in one frame.
    """
    found = marker_of_tracks(tracks, model, settings)
    names = np.array(["", *model.names], dtype=object)
    mine = np.array([found.get(int(track), -1) for track in tracks.track], dtype=int)
    label = np.where(mine >= 0, names[mine + 1], tracks.label.astype(object)).astype(np.str_)
    return replace(tracks, label=label)


def marker_of_tracks(tracks: Tracks, model: MarkerModel, settings: LabelSettings = DEFAULTS) -> dict[int, int]:
    """Return track -> index of the model's marker, for the tracks that can be identified."""
    measured = tracks.select(tracks.status == "measured")
    if not len(measured):
        return {}
    ids, column = np.unique(measured.track, return_inverse=True)
    frames, row = np.unique(measured.frame, return_inverse=True)
    xyz = np.full((len(frames), len(ids), 3), np.nan)
    xyz[row, column] = measured.xyz
    there = np.asarray(np.isfinite(xyz[:, :, 0]))
    fullest = int(there.sum(axis=1).argmax())
    part = slice(max(0, fullest - settings.window), fullest + settings.window + 1)
    some = np.flatnonzero(there[part].sum(axis=0) >= settings.least_samples)
    moments = _distance_moments(xyz[part][:, some])
    chosen = _beam(xyz[part][:, some], *moments, model, settings)
    chosen = _without_misfits(chosen, *moments, model, settings)
    of_column = np.full(len(ids), -1)
    for marker, k in enumerate(chosen):
        if k >= 0:
            of_column[some[k]] = marker
    _name_the_rest(xyz, there, of_column, model, settings)
    return {int(ids[k]): int(of_column[k]) for k in np.flatnonzero(of_column >= 0)}


def _without_misfits(
    chosen: Array, first: Array, second: Array, model: MarkerModel, settings: LabelSettings
) -> Array:
    """Return ``chosen`` (m,) after removing misfits, the worst first: each was chosen before the others were."""
    chosen = chosen.copy()
    while (chosen >= 0).any():
        named = np.flatnonzero(chosen >= 0)
        markers, tracks = np.ix_(named, named), np.ix_(chosen[named], chosen[named])
        sigma = model.sigma_m[markers]
        cost = _link_cost(first[tracks], second[tracks], model.mean_m[markers], sigma, settings)
        sigma = sigma + np.diag(np.full(len(named), np.inf))
        tight = np.argsort(sigma, axis=1, kind="stable")[:, :TIGHTEST]
        each = np.take_along_axis(cost, tight, axis=1).mean(axis=1)
        # loose links alone do not name a track where the model has firm ones
        firm = model.rigid[markers].sum(axis=1)
        each[firm < np.minimum(model.rigid[named].sum(axis=1), LEAST_FIRM)] = np.inf
        worst = int(each.argmax())
        if each[worst] < settings.margin and len(named) > 2:
            break
        chosen[named[worst]] = -1
    named, free = np.flatnonzero(chosen >= 0), np.flatnonzero(chosen < 0)
    better = []
    for k, i in enumerate(named):
        of_track = (chosen[i], np.delete(named, k), chosen, first, second, model, settings)
        as_free = min((_firm_cost(int(j), *of_track) for j in free), default=np.inf)
        better.append(as_free < _firm_cost(int(i), *of_track))
    chosen[named[np.array(better, dtype=bool)]] = -1  # these fit a marker without a track better
    return chosen


def _firm_cost(
    i: int,
    track: int,
    named: Array,
    chosen: Array,
    first: Array,
    second: Array,
    model: MarkerModel,
    settings: LabelSettings,
) -> float:
    """Return the mean cost of ``track`` as marker ``i`` by its firm links to ``named`` (k,); inf without any."""
    firm = named[model.rigid[i, named]]
    if not len(firm):
        return np.inf
    at = first[track, chosen[firm]], second[track, chosen[firm]]
    return float(_link_cost(*at, model.mean_m[i, firm], model.sigma_m[i, firm], settings).mean())


def _beam(xyz: Array, first: Array, second: Array, model: MarkerModel, settings: LabelSettings) -> Array:
    """Return the track (m,) of each marker among ``xyz`` (t, n, 3), -1 where there is none or it is ambiguous."""
    still = xyz[np.isfinite(xyz).all(axis=2).sum(axis=1).argmax()]  # sides are decided in the fullest frame
    m, n = len(model.names), xyz.shape[1]
    order = _order(model)
    chosen, cost = np.full((1, m), -1), np.zeros(1)
    for step, i in enumerate(order):
        extra = _extension(i, order[:step], chosen, first, second, model, settings)
        extra += _side_costs(i, order[:step], chosen, still, model, settings)
        taken = np.zeros((len(chosen), n), dtype=bool)
        rows, columns = np.nonzero(chosen >= 0)
        taken[rows, chosen[rows, columns]] = True
        extra[taken] = np.inf
        total = np.concatenate([cost[:, None] + extra, cost[:, None] + settings.missing], axis=1).ravel()
        best = np.argsort(total, kind="stable")[: settings.beam if step > 1 else 10 * settings.beam]
        best = best[np.isfinite(total[best])]
        parent, track = np.divmod(best, n + 1)
        chosen, cost = chosen[parent], total[best]
        chosen[:, i] = np.where(track < n, track, -1)
    near = chosen[cost < cost[0] + settings.margin]
    # a marker with another track in an assignment about as good is ambiguous; no track is not another track
    doubtful = ((near != chosen[0]) & (near >= 0)).any(axis=0)
    return np.where(doubtful, -1, chosen[0])


def _order(model: MarkerModel) -> list[int]:
    """Return the markers in an order in which each has the firmest links to those before it."""
    firm = np.nan_to_num(1.0 / model.sigma_m**2)
    np.fill_diagonal(firm, 0.0)
    order = [int(np.sort(firm, axis=1)[:, -3:].sum(axis=1).argmax())]
    while len(order) < len(firm):
        links = np.sort(firm[:, order], axis=1)[:, -3:].sum(axis=1)
        links[order] = -1.0
        order.append(int(links.argmax()))
    return order


def _distance_moments(xyz: Array) -> tuple[Array, Array]:
    """Return mean distance and mean squared distance (n, n) of all pairs over the frames that show both."""
    n = xyz.shape[1]
    first, second = np.full((n, n), np.nan), np.full((n, n), np.nan)
    for k in range(n):
        squared = np.sum((xyz - xyz[:, k : k + 1]) ** 2, axis=2)
        both = np.isfinite(squared)
        count = np.where(both.any(axis=0), both.sum(axis=0), np.nan)
        second[k] = np.where(both, squared, 0.0).sum(axis=0) / count
        first[k] = np.where(both, np.sqrt(squared), 0.0).sum(axis=0) / count
    return first, second


def _link_cost(first: Array, second: Array, mean: Array, sigma: Array, settings: LabelSettings) -> Array:
    """Return the bounded mean squared deviation of distances from the model's, in its standard deviations."""
    cost = (second - 2 * mean * first + mean**2) / (sigma**2 + settings.noise_m**2)
    return np.asarray(np.where(np.isfinite(cost), np.minimum(cost, settings.bound), NEUTRAL))


def _extension(
    i: int, before: list[int], chosen: Array, first: Array, second: Array, model: MarkerModel, settings: LabelSettings
) -> Array:
    """Return the cost (b, n) of giving marker ``i`` each track, for each assignment ``chosen`` (b, m)."""
    n = len(first)
    if not before:
        return np.full((len(chosen), n), NEUTRAL)
    sigma = model.sigma_m[i, before]
    links = [before[k] for k in np.argsort(sigma, kind="stable")[:LINKS] if np.isfinite(sigma[k])]
    count, total = np.zeros(len(chosen), dtype=int), np.zeros((2, len(chosen), n))
    loose = np.zeros(len(chosen), dtype=int)
    for j in links:
        table = _link_cost(first, second, model.mean_m[i, j], model.sigma_m[i, j], settings)
        there = chosen[:, j] >= 0
        tight = there & (count < TIGHTEST)
        total[0, tight] += table[chosen[tight, j]]
        count[tight] += 1
        wide = there & ~tight
        total[1, wide] += table[chosen[wide, j]]
        loose[wide] += 1
    cost = total[0] / np.maximum(count, 1)[:, None] + total[1] / np.sqrt(np.maximum(loose, 1))[:, None]
    return np.asarray(np.where(count[:, None] > 0, cost, NEUTRAL))


def _side_costs(
    i: int, before: list[int], chosen: Array, still: Array, model: MarkerModel, settings: LabelSettings
) -> Array:
    """Return the cost (b, n) of sets of four that are mirrored when marker ``i`` is given each track."""
    cost = np.zeros((len(chosen), len(still)))
    count = np.zeros(len(chosen))
    known = set(before)
    for quad, volume in zip(model.quads.tolist(), model.volume_m3.tolist(), strict=True):
        others = [k for k in quad if k != i]
        if len(others) == 4 or not known.issuperset(others):
            continue
        rows = np.flatnonzero((chosen[:, others] >= 0).all(axis=1))
        corners = still[chosen[np.ix_(rows, others)]]
        place = quad.index(i)
        # the new marker goes last; an odd permutation flips the sign
        sign = -1.0 if (3 - place) % 2 else 1.0
        a, b, c = (corners[:, None, k] for k in range(3))
        seen = sign * np.sum(np.cross(b - a, c - a) * (still[None] - a), axis=2)
        share = np.clip(-2.0 * seen / volume, 0.0, 1.0)
        cost[rows] += np.nan_to_num(settings.wrong_side * share)
        count[rows] += 1
    return np.asarray(cost / np.maximum(count, 1)[:, None])


def _name_the_rest(xyz: Array, there: Array, of_column: Array, model: MarkerModel, settings: LabelSettings) -> None:
    """Name tracks without a marker in ``of_column`` (n,), the most certain first, until none is certain."""
    while True:
        best: tuple[float, int, int] | None = None
        for k in np.flatnonzero((of_column < 0) & (there.sum(axis=0) >= settings.least_samples)):
            busy = of_column[there[there[:, k]].any(axis=0)]
            open_markers = np.setdiff1d(np.arange(len(model.names)), busy)
            costs = sorted(
                (_cost_as(int(i), int(k), xyz, there, of_column, model, settings), int(i)) for i in open_markers
            )
            sure = costs and costs[0][0] < settings.margin
            alone = sure and (len(costs) == 1 or costs[1][0] > costs[0][0] + settings.margin)
            if alone and (best is None or costs[0][0] < best[0]):
                best = costs[0][0], int(k), costs[0][1]
        if best is None:
            return
        of_column[best[1]] = best[2]


def _cost_as(
    i: int, k: int, xyz: Array, there: Array, of_column: Array, model: MarkerModel, settings: LabelSettings
) -> float:
    """Return the mean cost of the firmest links of track ``k`` as marker ``i``; infinite for fewer than three."""
    costs: list[float] = []
    firm = 0
    for j in np.argsort(model.sigma_m[i], kind="stable"):
        if j == i or not np.isfinite(model.sigma_m[i, j]):
            continue
        together = there[:, k, None] & there & (of_column == j)
        rows, columns = np.nonzero(together)
        if len(rows) < settings.least_samples:
            continue
        away = np.linalg.norm(xyz[rows, k] - xyz[rows, columns], axis=1)
        first, second = np.array(away.mean()), np.array((away**2).mean())
        costs.append(float(_link_cost(first, second, model.mean_m[i, j], model.sigma_m[i, j], settings)))
        firm += bool(model.rigid[i, j])
        if len(costs) == TIGHTEST:
            break
    enough = len(costs) >= 3 and firm >= min(LEAST_FIRM, int(model.rigid[i].sum()))
    return float(np.mean(costs)) if enough else np.inf
