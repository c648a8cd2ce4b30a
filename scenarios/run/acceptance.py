"""Metrics of a scenario's acceptance test."""

import math
from pathlib import Path

from mosca.accuracy.acceptance.artefact import read_acceptance
from mosca.accuracy.acceptance.evaluate import accept_tracks
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from scenarios.build.scene import beside
from scenarios.spec.scenario import Scenario
from scenarios.types import Score


def acceptance_scores(spec: Scenario, folder: Path, tracks: Tracks) -> tuple[dict[str, Score], list[str]]:
    """Return the scores of the scenario's acceptance test on ``tracks``, and notes, one line each.

    A share is given only where every length or figure was measured; otherwise a note names the missing one.
    """
    if spec.acceptance is None:
        return {}, []
    given = read_acceptance(beside(spec.acceptance.file, folder))
    try:
        found = accept_tracks(tracks, given, None, spec.acceptance.file)
    except InputError as error:
        return {}, [str(error)]
    scores: dict[str, Score] = {}
    notes = [f"{given.title}: {found.decision}"]
    parts = (("length_error_share", found.lengths), ("cluster_error_share", found.clusters))
    for name, part in parts:
        if part is None:
            continue
        notes += [f"not met: {one.text}" for one in part.premises if not one.met]
        if part.complete and math.isfinite(part.share):
            scores[name] = Score(part.share, part.samples)
    return scores, notes
