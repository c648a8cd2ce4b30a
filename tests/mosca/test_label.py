"""Labels from a marker model: an articulated figure that is the same on both sides, and CMU's walkers."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from track_points import made_tracks

from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.motion import forward_kinematics
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.labelling.assign import label_tracks, marker_of_tracks
from mosca.labelling.marker_model import learn_model, volumes_of

# limb -> joint it hangs on (m, x left, y back, z up) and its markers from there; right limbs mirror left ones
TORSO = {
    "chest": (0.02, -0.12, 1.35), "back": (-0.06, 0.1, 1.3), "waist": (0.05, -0.1, 1.0), "spine": (0.0, 0.12, 1.1),
    "shoulder_l": (0.19, 0.0, 1.45), "shoulder_r": (-0.19, 0.0, 1.45),
}  # fmt: skip
ARM = {"elbow": (0.03, 0.03, -0.3), "upper": (0.05, -0.03, -0.12), "fore": (-0.04, 0.02, -0.41),
       "wrist": (0.02, -0.04, -0.52)}  # fmt: skip
LEG = {"thigh": (0.07, -0.05, -0.2), "knee": (0.05, -0.04, -0.42), "shin": (-0.03, 0.05, -0.57),
       "ankle": (0.05, 0.02, -0.8)}  # fmt: skip
LEFT = {"arm": ((0.2, 0.0, 1.42), ARM), "leg": ((0.1, 0.0, 0.9), LEG)}
LIMBS = {"torso": tuple(TORSO)} | {
    f"{limb}_{side}": tuple(f"{name}_{side}" for name in marks) for limb, (_, marks) in LEFT.items() for side in "lr"
}  # fmt: skip


def figure(times: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Names (m) and positions (t, m, 3) of markers on a person who swings arms and legs while turning and walking."""
    names, paths = list(TORSO), [np.tile(place, (len(times), 1)) for place in TORSO.values()]
    for limb, (joint, marks) in LEFT.items():
        for side, mirror, phase in (("l", 1, 0.0), ("r", -1, np.pi)):
            swing = 0.6 * np.sin(4 * times + phase + (limb == "leg") * np.pi)
            turns = Rotation.from_rotvec(np.stack([swing, 0 * swing, 0.2 * mirror * np.cos(3 * times)], axis=1))
            for name, place in marks.items():
                names.append(f"{name}_{side}")
                at = np.array(joint) + turns.apply(np.array(place) * [mirror, 1, 1])
                at[:, 0] += (mirror - 1) * joint[0]
                paths.append(at)
    whole = Rotation.from_rotvec(np.stack([0 * times, 0 * times, 0.8 * times], axis=1))
    walked = [whole.apply(path) + np.stack([0.5 * times, 0 * times, 0 * times], axis=1) for path in paths]
    return names, np.stack(walked, axis=1)


def as_tracks(xyz: np.ndarray, label=None, track=None, seen=None) -> Tracks:
    """Tracks of positions (t, m, 3) where ``seen`` (t, m); ``label`` (m) and ``track`` (t, m) of each marker."""
    t, m = xyz.shape[:2]
    label = np.full(m, "") if label is None else np.asarray(label)
    track = np.tile(np.arange(m), (t, 1)) if track is None else track
    rows, columns = np.nonzero(np.ones((t, m)) if seen is None else seen)
    return made_tracks(rows, track[rows, columns], xyz[rows, columns], label=label[columns])


def learned(times: np.ndarray, limbs: dict[str, tuple[str, ...]] | None):
    names, xyz = figure(times)
    return learn_model(as_tracks(xyz, names), limbs)


def scrambled(
    rng: np.random.Generator, frames: int, clutter: int, hidden: float, broken: int
) -> tuple[Tracks, dict[int, str]]:
    """Unlabelled tracks of the figure, and what each is: some never seen, some that change their number half-way."""
    names, xyz = figure(10 + np.arange(frames) / 100)
    m = len(names)
    stray = rng.uniform(-1, 1, (1, clutter, 3)) + 0.05 * rng.normal(size=(frames, clutter, 3)).cumsum(axis=0) / 10
    xyz = np.concatenate([xyz, stray + xyz[:, :1]], axis=1) + rng.normal(0, 5e-4, (frames, m + clutter, 3))
    order = rng.permutation(m + clutter)
    track = np.tile(order, (frames, 1))
    what = {int(order[k]): names[k] if k < m else "" for k in range(m + clutter)}
    seen = rng.random(track.shape) > 0.05
    gone = rng.permutation(m)[: round(hidden * m)]
    seen[:, gone] = False
    for k in [k for k in rng.permutation(m) if k not in gone][:broken]:
        track[frames // 2 :, k] = 500 + k
        seen[frames // 2 : frames // 2 + 10, k] = False
        what[500 + int(k)] = names[k]
    return as_tracks(xyz, None, track, seen), what


@pytest.mark.parametrize(("pose", "least"), [("T-pose", 0.7), ("motion", 0.9)])
def test_a_symmetric_figure_is_labelled(pose: str, least: float) -> None:
    model = learned(np.array([0.0, 0.01]), LIMBS) if pose == "T-pose" else learned(np.linspace(0, 3, 60), None)
    wrong, right, total = 0, 0, 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        tracks, what = scrambled(rng, 120, clutter=4, hidden=0.1, broken=3)
        done = label_tracks(tracks, model)
        for track in np.unique(done.track).tolist():
            given = set(done.label[done.track == track].tolist())
            assert len(given) == 1
            label = given.pop()
            total += what[track] != ""
            right += label != "" and label == what[track]
            wrong += label not in ("", what[track])
    assert wrong == 0
    assert right >= least * total


def test_the_mirror_image_is_not_taken_for_the_subject() -> None:
    model = learned(np.linspace(0, 3, 60), None)
    names, xyz = figure(10 + np.arange(80) / 100)
    rng = np.random.default_rng(5)
    assert len(model.quads)
    found = marker_of_tracks(as_tracks(xyz + rng.normal(0, 5e-4, xyz.shape)), model)
    at = [found[k] for k in range(len(names))]
    assert [model.names[k] for k in at] == names
    quads = volumes_of(xyz[:, np.argsort(at)], model.quads)
    assert (np.sign(quads) == np.sign(model.volume_m3)).all()


def test_others_keep_their_labels_and_nothing_gives_nothing() -> None:
    model = learned(np.linspace(0, 3, 60), None)
    assert len(label_tracks(Tracks.none(), model)) == 0
    rng = np.random.default_rng(6)
    xyz = rng.uniform(-1, 1, (1, 8, 3)) + 0.01 * rng.normal(size=(60, 8, 3)).cumsum(axis=0)
    done = label_tracks(as_tracks(xyz, ["lamp", *[""] * 7]), model)
    assert set(done.label[done.track == 0]) == {"lamp"}
    assert set(done.label[done.track > 0]) == {""}


def test_what_cannot_be_learned() -> None:
    names, xyz = figure(np.linspace(0, 1, 5))
    with pytest.raises(InputError, match="0 labels in the stretch"):
        learn_model(as_tracks(xyz))
    with pytest.raises(InputError, match="limb 'tail': marker 'tip' is not in the stretch; it has ankle_l"):
        learn_model(as_tracks(xyz, names), {"tail": ("tip",)})


@pytest.mark.data
@pytest.mark.parametrize(("other", "least"), [("02_02", 0.95), ("02_03", 0.6)])
def test_a_real_subject_with_markers_on_all_limbs(other: str, least: float, data_dir: Path) -> None:
    """Markers fixed to CMU's bones: learned from a walk, labelled in another and in a run, 10 % of them missing."""
    rng = np.random.default_rng(7)
    parts = ["hip", "chest", "head", *(f"{s}{p}" for p in ("Thigh", "Shin", "Shldr", "ForeArm") for s in "lr")]
    offsets = rng.uniform(-0.12, 0.12, (len(parts), 4, 3))
    paths = []
    for name in ("02_01", other):
        motion = read_bvh(data_dir / f"cmu_mocap/bvh/02/{name}.bvh", metres_per_unit=0.0104, drop_frames=1)
        position, turn = forward_kinematics(motion)
        rows = [motion.skeleton.index(p) for p in parts]
        markers = position[:, rows, None] + np.einsum("tpij,pkj->tpki", turn[:, rows], offsets)
        paths.append(markers.reshape(len(markers), -1, 3)[:340:2])
    names = np.array([f"{p}{k}" for p in parts for k in range(4)])
    m = len(names)
    model = learn_model(as_tracks(paths[0], names))
    xyz = paths[1] + rng.normal(0, 5e-4, paths[1].shape)
    order = rng.permutation(m)
    seen = rng.random(xyz.shape[:2]) > 0.05
    seen[:, rng.permutation(m)[: m // 10]] = False
    found = marker_of_tracks(as_tracks(xyz, None, np.tile(order, (len(xyz), 1)), seen), model)
    true = names[np.argsort(order)]
    assert [t for t in found if model.names[found[t]] != true[t]] == []
    assert len(found) >= least * seen.any(axis=0).sum()
