"""Errors that a user can correct: one line that names file, key, value, what is allowed and what to do."""

import re


class MoscaError(Exception):
    """A known error. The command line prints its text on one line and exits with 2.

    The text may contain a user's input, so unprintable characters are written as in Python: a line feed as \\n.
    """

    def __init__(self, text: object = "") -> None:
        super().__init__("".join(one if one.isprintable() else repr(one)[1:-1] for one in str(text)))


class InputError(MoscaError):
    """A file, a key or a value that cannot be used as it is."""


class CalibrationError(MoscaError):
    """Observations that do not determine a camera, or a camera that cannot be right.

    A text may begin with the code of a finding ("little-depth: ..."). ``unseen``: the cameras that saw too little,
    without which the others might be calibrated.
    """

    def __init__(self, text: object = "", unseen: tuple[str, ...] = ()) -> None:
        super().__init__(text)
        self.unseen = unseen

    @property
    def code(self) -> str:
        """The code that the text begins with, "" where there is none."""
        found = re.match(r"([a-z]+(?:-[a-z]+)+): ", str(self))
        return "" if found is None else found[1]


class PremiseError(MoscaError):
    """A scenario whose stated premises do not hold, so that its score would mean nothing."""
