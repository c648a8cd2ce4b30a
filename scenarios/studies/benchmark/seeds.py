"""Held-out seeds: drawn from a passphrase whose SHA-256 was in the repository before the passphrase was.

Before a round, settings are tuned and frozen, and the hash of a passphrase is committed. The benchmark is then run
with the passphrase, which is published with the result. Anyone can check that the hash is that of the passphrase, and
that it is older than the result. This does not prove that nobody who knew the passphrase tuned on it. For that there
is ``--fresh``, which draws a passphrase that nobody has known.
"""

import hashlib
import secrets
from dataclasses import dataclass
from pathlib import Path

from mosca.data.files.toml import Table, check, read_toml
from mosca.errors import InputError

ROUNDS = Path(__file__).with_name("rounds.toml")
TUNING = "tuning"
"""The public passphrase of the seeds for tuning; a held-out passphrase must differ from it."""


class Round(Table):
    """One round of the benchmark in ``rounds.toml``."""

    commitment_sha256: str
    passphrase: str | None = None
    sets: tuple[str, ...] = ()
    """The data sets of the round; none: all."""


class Rounds(Table):
    """All rounds, the newest last."""

    round: tuple[Round, ...]


@dataclass(frozen=True)
class Passphrase:
    """A passphrase from which seeds are drawn, and its description."""

    text: str
    told: str
    """Description in words, for the result."""
    sets: tuple[str, ...] = ()
    """The data sets of its round; none: all."""

    @property
    def sha256(self) -> str:
        """Its hash, in hexadecimal digits."""
        return digest(self.text)

    def seed(self, name: str) -> int:
        """Return the seed of the data set ``name``: the first 31 bits of SHA-256 of ``PASSPHRASE/NAME``."""
        return int(digest(f"{self.text}/{name}")[:8], 16) >> 1


def digest(text: str) -> str:
    """Return SHA-256 of a text in UTF-8, in hexadecimal digits."""
    return hashlib.sha256(text.encode()).hexdigest()


def tuning() -> Passphrase:
    """Return the passphrase of the tuning seeds."""
    return Passphrase(TUNING, "tuning seeds: settings were tuned on them")


def fresh() -> Passphrase:
    """Return a passphrase that nobody has known."""
    return Passphrase(secrets.token_hex(16), "drawn for this run")


def published(path: Path = ROUNDS) -> Passphrase | None:
    """Return the passphrase of the newest published round, None where there is none yet.

    InputError where its hash is not the committed one.
    """
    rounds = check(Rounds, read_toml(path), path).round
    for number, one in reversed(list(enumerate(rounds, start=1))):
        if one.passphrase is not None:
            if digest(one.passphrase) != one.commitment_sha256:
                raise InputError(
                    f"{path}: round {number}: SHA-256 of passphrase is {digest(one.passphrase)}, committed was "
                    f"{one.commitment_sha256}; run with --fresh, and distrust this round"
                )
            told = f"round {number} of the repository; its hash was committed before"
            return Passphrase(one.passphrase, told, one.sets)
    return None


def given(text: str) -> Passphrase:
    """Return the passphrase that a user gives; InputError for that of the tuning seeds, and for an empty one."""
    if not text.strip() or text == TUNING:
        raise InputError(
            f"--passphrase {text!r}: settings were tuned on the seeds of '{TUNING}', and an empty one is none; "
            "give another one"
        )
    return Passphrase(text, "given for this run")
