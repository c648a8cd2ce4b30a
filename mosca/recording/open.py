"""Opening of recordings: what a folder holds, and which part of it belongs to which camera of the rig."""

import difflib
from collections.abc import Sequence
from pathlib import Path

from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.recording.folder import FolderFeed, check_size, folder_feed, has_numbered_images
from mosca.recording.image_sequence import NumberedRecording
from mosca.recording.mcap_source import McapRecording
from mosca.recording.stamps import EvenStamps, Stamps, TableStamps, read_stamps
from mosca.recording.video import VIDEO_SUFFIXES, VideoFeed, stated_rate_hz, video_feed
from mosca.recording.writer import MCAP_NAME, PART_NAME

Recording = McapRecording | NumberedRecording
WANTED = (
    "wanted is recording.mcap, a folder of numbered images (png, tif, bmp, jpg) for each camera, "
    "or a video (mp4, mkv, avi, mov) for each camera, itself or in a folder called like the camera"
)


def open_recording(
    path: Path, rig: Rig | None = None, fps: float | None = None, *, times_matter: bool = True
) -> Recording:
    """Open the recording in folder ``path`` as a FrameSource.

    ``rig``: read its cameras only, in its order and under its names; a camera ``cam1`` reads the entry
    ``cam1``, else the only entry whose name ends with it (``Images_cam1``). Without a rig every folder of
    numbered images (else every video) is a camera, in order of name; where there is neither, every folder with one
    video or one subfolder of numbered images is a camera. ``fps``: frame rate [1/s], needed where there is no
    ``frames.csv``; a ``recording.mcap`` carries its own times and needs none. ``times_matter``: False where only
    frames of one number must belong together, as in a calibration; then no rate is needed.

    Raises InputError where there is no recording, a camera is missing, the images are not of the size that
    the rig states, or the frame rate is unknown.
    """
    path = Path(path)
    if fps is not None and not 0 < fps < float("inf"):
        raise InputError(f"--fps {fps:g}: a frame rate above 0 is wanted")
    check_recording(path)
    if path.is_file():
        return _open_mcap(path, rig)
    for name in (MCAP_NAME, PART_NAME):
        if (path / name).exists():
            return _open_mcap(path / name, rig)
    return _open_numbered(path, rig, fps, times_matter)


def check_recording(path: Path) -> None:
    """Raise InputError where ``path`` is neither a folder nor an MCAP file; looks at nothing else."""
    if path.is_file() and not path.name.endswith((".mcap", ".mcap.part")):
        raise InputError(f"{path}: is a file; a recording is a folder of images or videos, or a .mcap file")
    if not path.exists():
        raise InputError(f"{path}: no such folder{_similar(path)}; a recording is a folder")


def _open_mcap(path: Path, rig: Rig | None) -> McapRecording:
    recording = McapRecording(path, rig.names if rig is not None else None)
    for info in recording.cameras:
        check_size(path, (info.width, info.height), rig.camera(info.name) if rig is not None else None)
    return recording


def _open_numbered(path: Path, rig: Rig | None, fps: float | None, times_matter: bool) -> NumberedRecording:
    cameras, use_folders = _cameras(path, rig)
    names = rig.names if rig is not None else tuple(cameras)
    entries = {name: _match(name, tuple(cameras), path) for name in names}
    found = {name: cameras[entry] for name, entry in entries.items()}
    table = path / "frames.csv"
    if not table.exists() and fps is None:
        stated = None if use_folders else stated_rate_hz(next(iter(found.values())))
        if times_matter:
            said = f" (the video states {stated:g})" if stated else ""
            raise InputError(f"{path}: no frames.csv says when its frames were taken; pass --fps{said}")
        fps = stated or 1.0
    table_stamps = None
    if table.exists():
        entries_of = {entry: name for name, entry in entries.items()}
        table_stamps = read_stamps(table, entries_of, fps)
    rate_hz = table_stamps.rate_hz if table_stamps is not None else fps or 0.0
    feeds: list[FolderFeed | VideoFeed] = []
    notes = []
    for name, entry in found.items():
        camera = rig.camera(name) if rig is not None else None
        if use_folders:
            feeds.append(folder_feed(name, entry, camera, rate_hz))
        else:
            feed, note = video_feed(name, entry, camera, rate_hz)
            feeds.append(feed)
            notes += [note] if note else []
    first, last = _span(feeds, table_stamps, path)
    stamps: Stamps = table_stamps if table_stamps is not None else EvenStamps(rate_hz, first)
    return NumberedRecording(tuple(feeds), first, last, stamps, tuple(notes))


def _cameras(path: Path, rig: Rig | None) -> tuple[dict[str, Path], bool]:
    """Return the folder of images or the video of each camera in ``path``, and whether they are folders."""
    entries = _sorted(path)
    folders = {e.name: e for e in entries if e.is_dir() and has_numbered_images(e)}
    videos = _videos(entries)
    if not folders and not videos:
        inside = {e.name: _sorted(e) for e in entries if e.is_dir()}
        for name, within in inside.items():
            # as other programs keep them: camera/calibration_images/...
            deeper = [e for e in within if e.is_dir()]
            full = [e for e in deeper if has_numbered_images(e)]
            here = _videos(within) or _videos([file for e in deeper for file in _sorted(e)])
            if len(full) + len(here) > 1:
                raise InputError(
                    f"{path / name}: {len(full)} folders of images and {len(here)} videos; keep one for each camera"
                )
            folders.update((name, e) for e in full)
            videos.update((name, e) for e in here.values())
    if not folders and not videos:
        loose = f"; numbered images lie in {path} itself" if has_numbered_images(path) else ""
        raise InputError(f"{path}: no recording in it{loose}; {WANTED}")
    use_folders = bool(folders) and (rig is None or not videos or _all_found(folders, rig.names))
    return (folders if use_folders else videos), use_folders


def _videos(entries: Sequence[Path]) -> dict[str, Path]:
    """Return the videos by name without suffix; a name in several containers gives the first of VIDEO_SUFFIXES."""
    files = [e for e in entries if e.suffix.lower() in VIDEO_SUFFIXES and e.is_file()]
    files.sort(key=lambda file: -VIDEO_SUFFIXES.index(file.suffix.lower()))
    return dict(sorted((file.stem, file) for file in files))


def _span(feeds: Sequence[FolderFeed | VideoFeed], table: TableStamps | None, path: Path) -> tuple[int, int]:
    """Return the smallest and the largest frame number of all cameras; check that they are plausible."""
    numbers: set[int] = set()
    for feed in feeds:
        there = feed.frame_numbers()
        numbers |= there
        lost = there - set(table.numbers[feed.info.name]) if table is not None else set()
        if lost:
            raise InputError(
                f"{path / 'frames.csv'}: no line for frame {min(lost)} of camera '{feed.info.name}', which is "
                f"there ({len(lost)} such frames); add its time or remove the image"
            )
        numbers |= set(table.numbers[feed.info.name]) if table is not None else set()
    first, last = min(numbers), max(numbers)
    if last - first > 100 * len(numbers) + 10_000:
        raise InputError(
            f"{path}: {len(numbers)} frames are numbered from {first} to {last}; "
            "that many cannot be missing: are the digits at the end of the names frame numbers?"
        )
    return first, last


def _match(name: str, entries: Sequence[str], path: Path) -> str:
    """Return the entry of camera ``name``: of that name, else the only one whose name ends with it."""
    ending = [entry for entry in entries if entry.endswith(name)]
    if name in entries:
        return name
    if len(ending) == 1:
        return ending[0]
    what = f"{len(ending)} entries end with" if ending else "nothing is called or ends with"
    raise InputError(
        f"{path}: {what} the rig's camera name '{name}'; there is {', '.join(entries)}; "
        "rename a folder or video to the camera's name"
    )


def _all_found(entries: dict[str, Path], names: Sequence[str]) -> bool:
    return all(any(entry.endswith(name) for entry in entries) for name in names)


def _sorted(path: Path) -> list[Path]:
    try:
        return sorted(path.iterdir())
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


def _similar(path: Path) -> str:
    if not path.parent.is_dir():
        return ""
    near = difflib.get_close_matches(path.name, [p.name for p in path.parent.iterdir()], n=1)
    return f"; did you mean '{path.parent / near[0]}'?" if near else ""
