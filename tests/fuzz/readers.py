"""All readers of files that users give, by their names."""

from fuzz import tables, toml_files
from fuzz.reader import Reader

READERS: dict[str, Reader] = {one.name: one for one in (*toml_files.READERS, *tables.READERS)}
