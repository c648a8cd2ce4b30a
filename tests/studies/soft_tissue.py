"""How far the actor's markers slide on the bones: rms by segment, for the table of docs/people.md.

Run: ``python -m tests.studies.soft_tissue [--seeds N] [--seconds S]``. Rms about each marker's own mean over the
time, over the segment's markers and the seeds; in brackets the largest distance from that mean.
"""

import argparse
from collections.abc import Sequence

import numpy as np

from mosca.data.arrays import Array
from twin.scenes.actions import ActionName
from twin.scenes.actor import build_actor
from twin.scenes.actor_markers import MARKER_SITES
from twin.scenes.soft_tissue import STRONG_M, Skin, SoftTissue

RATE_HZ = 50.0


def slid_m(action: ActionName, skin: Skin, seed: int, duration_s: float) -> tuple[tuple[str, ...], Array]:
    """Return the markers' parts (m) and their displacements (t, m, 3) in the bones' axes [m] from their means."""
    scene = build_actor(
        duration_s=duration_s,
        box_center_m=np.array([0.0, 0.0, 1.5]),
        box_size_m=np.array([3.5, 3.5, 3.0]),
        rng=np.random.default_rng(seed),
        action=action,
        skin=skin,
        markers=60,
    )
    path = scene.configuration_at
    assert isinstance(path, SoftTissue)
    slid = np.array([path(t)[path.slides] for t in np.arange(0.0, duration_s, 1 / RATE_HZ)])
    kinds = {site.name: site.part.removeprefix("l_").removeprefix("r_") for site in MARKER_SITES}
    return tuple(kinds[name] for name in scene.marker_names), slid - slid.mean(axis=0)


def table(actions: Sequence[ActionName], seeds: int, duration_s: float) -> str:
    """Return the table of both levels, in millimetres."""
    skins: tuple[Skin, ...] = ("moderate", "strong")
    heads = [f"{action}, {skin}" for skin in skins for action in actions]
    lines = [f"| segment | at 1 rad, strong | {' | '.join(heads)} |", "|---" * (2 + len(heads)) + "|"]
    columns: list[dict[str, str]] = []
    for skin in skins:
        for action in actions:
            found = [slid_m(action, skin, seed, duration_s) for seed in range(1, 1 + seeds)]
            parts = np.array(found[0][0])
            size_mm = 1e3 * np.linalg.norm([slid for _, slid in found], axis=-1)
            columns.append(
                {
                    kind: f"{np.sqrt(np.mean(size_mm[..., parts == kind] ** 2)):.1f} "
                    f"({size_mm[..., parts == kind].max():.0f})"
                    for kind in STRONG_M
                    if (parts == kind).any()
                }
            )
    for kind in columns[0]:
        cells = " | ".join(column[kind] for column in columns)
        lines.append(f"| {kind.replace('_', ' ')} | {1e3 * STRONG_M[kind]:.1f} | {cells} |")
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=24.0)
    given = parser.parse_args()
    print(table(("walk", "range_of_motion", "jump", "boxing"), given.seeds, given.seconds))


if __name__ == "__main__":
    main()
