"""Keys of a scenario file: ``[acceptance]``, the test by certified artefacts that the scene shows."""

from collections.abc import Collection

from pydantic import Field

from mosca.data.files.toml import Table

SHARES = ("length_error_share", "cluster_error_share")


class AcceptanceSpec(Table):
    """The acceptance test of the tracks, for length_error_share and cluster_error_share."""

    file: str = Field(description="acceptance file: artefacts with their certificates, measuring lines, limits")


def check_acceptance(given: AcceptanceSpec | None, limits: Collection[str]) -> None:
    """Raise ValueError where a limit belongs to a test that the scenario does not have."""
    for name in SHARES:
        if name in limits and given is None:
            raise ValueError(f"limits.{name} needs an acceptance test; add [acceptance], or take the limit away")
