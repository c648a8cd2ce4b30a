"""Search for scenario files, and the commented scenario to start from. No heavy imports, so that it is fast."""

import difflib
import json
from dataclasses import dataclass
from pathlib import Path

from mosca.data.files.whole_file import write_text
from mosca.errors import InputError
from scenarios.spec.new_scenario import SCHEMA, new_scenario
from scenarios.spec.scenario import Scenario, load_scenario, scenario_schema

LIBRARY = Path(__file__).resolve().parents[1] / "library"


@dataclass(frozen=True)
class Entry:
    """A scenario file and its content."""

    path: Path
    name: str
    spec: Scenario
    overrides: tuple[str, ...] = ()
    """``KEY=VALUE`` texts by which ``spec`` differs from the file."""


def find(name: str) -> Path:
    """Return the scenario file for ``name``: a path, or the name of a built-in scenario."""
    path = Path(name)
    if path.is_file():
        return path
    if path.suffix == ".toml":
        known = [scenario_name(p) for p in built_in() if p.stem == path.stem]
        if known:
            raise InputError(f"{name}: no such file; the built-in scenario is called '{known[0]}'")
        return path
    there = {scenario_name(p): p for p in built_in()}
    # the last part of a name is enough where it is unique
    short = [full for full, p in there.items() if p.stem == name]
    if name in there or len(short) == 1:
        return there.get(name) or there[short[0]]
    if short:
        raise InputError(f"{name}: {len(short)} scenarios end so: {', '.join(short)}; give one of these")
    if path.is_dir():
        raise InputError(
            f"{path}: is a folder; a scenario is a .toml file, or a name that 'mosca list' shows; of images: "
            f"recording:{path} with --rig RIG.toml"
        )
    if name and (LIBRARY / name).is_dir():
        raise InputError(f"{name}: is a folder of the built-in scenarios; 'mosca suite {name}' runs those in it")
    names = [*there, *(p.stem for p in there.values()), *(p.parent.name for p in there.values())]
    near = difflib.get_close_matches(name.lower(), names, n=1)
    hint = f"did you mean '{near[0]}'?" if near else "'mosca list' shows what there is"
    raise InputError(f"{name}: no such scenario or file; {hint}")


def built_in() -> list[Path]:
    """Return all scenario files of the project, by name."""
    return sorted(LIBRARY.rglob("*.toml"))


def scenario_name(path: Path) -> str:
    """Return a scenario's name: its path below the library, without the ending; elsewhere the file's stem."""
    path = path.resolve()
    if LIBRARY in path.parents:
        return path.relative_to(LIBRARY).with_suffix("").as_posix()
    return path.stem


def entries(paths: tuple[Path, ...], tier: str | None = None, overrides: tuple[str, ...] = ()) -> list[Entry]:
    """Return the scenarios of files and folders (all built-in ones where none is named), of one tier or of all.

    A path that does not exist may be a folder of the built-in scenarios, "subjects", or a scenario of these, "actor".
    ``overrides``: as in ``load_scenario``, for each of them.
    """
    files: list[Path] = []
    for path in paths:
        folder = path if path.exists() or path.is_absolute() else LIBRARY / path
        if folder.is_dir():
            files += sorted(folder.rglob("*.toml"))
        else:
            files.append(find(str(path)))
    chosen = files if paths else built_in()
    found = [Entry(path, scenario_name(path), load_scenario(path, overrides), overrides) for path in chosen]
    names = [e.name for e in found]
    for entry in found:
        if names.count(entry.name) > 1:
            raise InputError(f"{entry.path}: a second scenario is called '{entry.name}'; give one another name")
    return [e for e in found if tier is None or tier == "full" or e.spec.tier == tier]


def write_new(path: Path, subject: str = "cloud", cameras: int = 4, claim: str = "1 mm") -> None:
    """Write a commented scenario to start from, and the schema for editors beside it unless it exists.

    An existing file is not changed; the arguments are those of ``new_scenario``.
    """
    if path.exists():
        raise InputError(f"{path}: exists already; choose another name")
    if path.suffix != ".toml":
        raise InputError(f"{path}: a scenario file ends in .toml")
    if not path.parent.is_dir():
        raise InputError(f"{path}: no folder {path.parent}; make it first")
    write_text(path, new_scenario(subject, cameras, claim))
    schema = path.with_name(SCHEMA)
    if not schema.exists():
        write_text(schema, json.dumps(scenario_schema(), indent=2) + "\n")
