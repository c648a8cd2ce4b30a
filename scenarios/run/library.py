"""Run scenarios from Python: ``run_scenario("subjects/actor", cameras__count=8)``."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mosca.data.files.toml import check, read_toml
from scenarios.run import scenario
from scenarios.run.record import with_changed
from scenarios.run.scenario import RunResult
from scenarios.spec.catalog import find, scenario_name
from scenarios.spec.scenario import Scenario, changed_keys, set_key
from scenarios.types import RunOptions


def run_scenario(
    path_or_name: str | Path,
    changes: Mapping[str, Any] | None = None,
    /,
    *,
    options: RunOptions | None = None,
    **overrides: Any,
) -> RunResult:
    """Run one scenario from scene to score.

    Parameters
    ----------
    path_or_name
        A scenario file, or the name of a built-in scenario (``mosca list``).
    changes
        Dotted key -> value, for example ``{"cameras.count": 8}``.
    options
        Source of the frames, rendering threads and recordings; default: the twin, on all cores.
    **overrides
        The same as ``changes``, with ``__`` in place of the dot: ``cameras__count=8``.

    Returns
    -------
    RunResult
        ``record`` (metrics, limits, provenance), ``tracks`` and ``truth``, among others. Nothing is written.

    Raises
    ------
    InputError
        A file, key or value cannot be used; the message names it and what is allowed.
    PremiseError
        The scenario cannot be scored: markers too small or too few views, for example.
    """
    path = find(str(path_or_name))
    document = read_toml(path)
    for key, value in {**(changes or {}), **{k.replace("__", "."): v for k, v in overrides.items()}}.items():
        set_key(document, key, value, f"{key} = {value!r}")
    spec = check(Scenario, document, path)
    options = options or RunOptions(workers=os.cpu_count() or 1)
    result = scenario.run_scenario(spec, scenario_name(path), path.parent, options)
    return replace(result, record=with_changed(result.record, changed_keys(path, spec)))
