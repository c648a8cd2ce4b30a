"""Numbers in text files, as every program writes and reads them.

Python's ``float`` and ``int`` accept more: they read ``1_5`` as 15, so that one damaged byte of ``1.5`` would make
another number, and they read digits of other scripts. Here both are errors.
"""

from collections.abc import Iterable

BLANKS = " \t"
"""Characters allowed around a cell. Python's ``strip`` removes more, so that a damaged cell could become empty."""


def real(text: str) -> float:
    """Return the value of a decimal number, ``nan`` or ``inf``; ValueError for anything else."""
    return float(_plain(text))


def reals(texts: Iterable[str]) -> list[float]:
    """Return many numbers as ``real`` does, quickly."""
    texts = list(texts)
    _plain("".join(texts))
    return list(map(float, texts))


def integers(texts: Iterable[str]) -> list[int]:
    """Return whole numbers in decimal digits; ValueError for anything else."""
    texts = list(texts)
    _plain("".join(texts))
    return list(map(int, texts))


def _plain(text: str) -> str:
    if "_" in text or not text.isascii():
        raise ValueError(f"{text[:40]!r} holds what is no digit, point, sign or exponent")
    return text
