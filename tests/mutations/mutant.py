"""A mutant: a text of one file that is replaced by another, and the tests that should notice it."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
LISTS = (HERE / "planted.toml", HERE / "generated.toml")


@dataclass(frozen=True)
class Mutant:
    """``old`` stands once in ``file`` and is replaced by ``new``; ``tests``: arguments of pytest."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def applied(self, text: str) -> str:
        """Return the file's text with the bug; ValueError unless ``old`` stands in it once."""
        count = text.count(self.old)
        if count != 1:
            raise ValueError(f"mutant '{self.name}': its text stands {count} times in {self.file}; it must once")
        return text.replace(self.old, self.new)


def read_mutants(*paths: Path) -> tuple[Mutant, ...]:
    """Return the mutants of the lists (default: all)."""
    found = []
    for path in paths or LISTS:
        for name, fields in tomllib.loads(path.read_text()).items():
            found.append(Mutant(name, fields["file"], fields["old"], fields["new"], tuple(fields["tests"])))
    return tuple(found)
