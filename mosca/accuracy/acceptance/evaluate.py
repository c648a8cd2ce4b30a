"""All parts of an acceptance test of one take's tracks."""

from dataclasses import dataclass

import numpy as np

from mosca.accuracy.acceptance.artefact import AcceptanceFile
from mosca.accuracy.acceptance.clusters import ClusterResult, cluster_result
from mosca.accuracy.acceptance.decision import Decision, overall
from mosca.accuracy.acceptance.latency import LatencyResult, ResultArrivals, latency_result
from mosca.accuracy.acceptance.lengths import LengthResult, length_result
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.rigid_bodies.tracker import labelled_by_bodies


@dataclass(frozen=True)
class AcceptanceResult:
    """Parts of an acceptance test, None if not asked for; ``notes``: what could not be judged, a line each."""

    decision: Decision
    lengths: LengthResult | None
    clusters: ClusterResult | None
    latency: LatencyResult | None
    notes: tuple[str, ...]


def accept_tracks(
    tracks: Tracks, given: AcceptanceFile, arrivals: ResultArrivals | None, source: str
) -> AcceptanceResult:
    """Return the acceptance test of ``tracks``; ``source``: name of the tracks in messages.

    Tracks without the labels of the artefact's markers get them from the file's [[body]] tables. InputError where
    there is nothing to test: no tracks, or no label that the file names.
    """
    measured = tracks.select(tracks.status == "measured")
    if not len(measured):
        raise InputError(f"{source}: no measured samples; an acceptance test needs tracks of the artefact")
    notes = []
    if given.line:
        measured = _labelled(measured, given, source)
    if not np.isfinite(measured.covariance).all():
        notes.append(
            "covariances: not told (formats such as C3D and TRC hold none); uncertainties rest on the scatter of the "
            "samples and the certificate"
        )
    lengths = length_result(measured, given) if given.line else None
    clusters = cluster_result(measured, given) if given.clusters is not None else None
    limit_s = None if given.latency is None else given.latency.p99_s
    latency = None if arrivals is None else latency_result(measured, arrivals, limit_s, source)
    if latency is None:
        notes.append("latency: not told: nothing says when results were available (arrivals.csv)")
    parts: list[Decision] = [one.decision for one in (lengths, clusters) if one is not None]
    if limit_s is not None:
        parts.append("undecided" if latency is None or latency.decided is None else latency.decided.decision)
    return AcceptanceResult(overall(parts), lengths, clusters, latency, tuple(notes))


def _labelled(tracks: Tracks, given: AcceptanceFile, source: str) -> Tracks:
    """Return the tracks with the labels of the bars' markers."""
    wanted = {name for line in given.line for one in given.bar_of(line).length for name in one.markers}
    there = set(np.unique(tracks.label).tolist()) - {""}
    bodies = [one.rigid_body() for one in given.body if wanted & set(one.markers)]
    if not wanted <= there and bodies:
        tracks = labelled_by_bodies(tracks, bodies)
        there = set(np.unique(tracks.label).tolist()) - {""}
    if not wanted & there:
        known = ", ".join(sorted(there)[:8]) or "none"
        raise InputError(
            f"{source}: no marker of the artefact is among the labels ({known}); label the tracks, or add a [[body]] "
            "with the markers' places to the acceptance file"
        )
    return tracks
