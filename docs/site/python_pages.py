"""The page of the library's functions and types, by purpose; mkdocstrings fills it from the docstrings."""

import mosca

GROUPS = {
    "Stages": ("detect", "project", "match", "triangulate", "track", "reconstruct", "calibrate"),
    "Files": ("read_rig", "write_rig", "open_recording", "read_tracks", "write_tracks"),
    "Data": (
        "Rig", "Camera", "Pose", "MoscaLens", "OpenCVLens", "FisheyeLens", "Detections", "Points", "Triangulated",
        "Tracks", "Calibration",
    ),
    "Settings": ("DetectionSettings", "MatchSettings", "TrackSettings", "PipelineSettings"),
    "Errors": ("InputError", "CalibrationError"),
}  # fmt: skip


def pages() -> dict[str, str]:
    """Return the page (uri -> Markdown); ValueError where a public name is in no group."""
    listed = [name for names in GROUPS.values() for name in names]
    if set(listed) != set(mosca.__all__):
        raise ValueError(f"docs/site/python_pages.py: {', '.join(sorted(set(listed) ^ set(mosca.__all__)))}")
    text = [
        "# Functions and types\n",
        "`import mosca`; [examples that run](../library.md). Conventions:",
        _conventions(),
    ]
    for title, names in GROUPS.items():
        text.append(f"## {title}\n")
        text += [f"::: {_home(name)}\n" for name in names]
    text.append("## Scenarios\n\n::: scenarios.run.library.run_scenario\n")
    return {"reference/python.md": "\n".join(text)}


def _conventions() -> str:
    """Return the list of conventions in the package's docstring."""
    assert mosca.__doc__ is not None
    return mosca.__doc__.split("Conventions:\n", 1)[1].replace("``", "`")


def _home(name: str) -> str:
    """Return where a public name is defined: its docstring is read there."""
    value = getattr(mosca, name)
    return f"{value.__module__}.{value.__name__}"
