"""All readers of files that users give, by their names."""

from fuzz import acceptance, benchmark_sets, joints, recordings, rig_formats, tables, toml_files
from fuzz.reader import Reader

READERS: dict[str, Reader] = {
    one.name: one
    for module in (toml_files, acceptance, rig_formats, tables, joints, recordings, benchmark_sets)
    for one in module.READERS
}
