"""The viewer as a program: what it is given, and one line where it cannot show anything."""

import sys

import pytest

from mosca.errors import InputError
from reports import viewer_program
from reports.viewer_program import show


@pytest.fixture
def seen(tmp_path, monkeypatch):
    """A viewer that records its arguments; it fails where the file's name contains 'bad'."""
    program, out = tmp_path / "rerun", tmp_path / "seen"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nopen({str(out)!r}, 'w').write(' '.join(sys.argv[1:]))\n"
        "sys.exit('bad' in sys.argv[1])\n"
    )
    program.chmod(0o755)
    monkeypatch.setattr(viewer_program, "viewer_program", lambda wanted_by: str(program))
    monkeypatch.setenv("DISPLAY", ":0")
    return out


@pytest.mark.parametrize(("web", "option"), [(False, "--port auto"), (True, "--web-viewer")])
def test_a_run_folder_or_a_file_is_shown_on_this_machine_alone(tmp_path, seen, web, option):
    file = tmp_path / "run.rrd"
    file.touch()
    for given in (tmp_path, file):
        show(given, web)
        assert seen.read_text() == f"{file} {option} --bind 127.0.0.1"
        seen.unlink()


def test_what_cannot_be_shown_is_one_line(tmp_path, seen, monkeypatch):
    with pytest.raises(InputError, match=r"run\.rrd: no such file; a run writes it with --rrd"):
        show(tmp_path)
    (tmp_path / "bad.rrd").touch()
    with pytest.raises(InputError, match="ended with code 1"):
        show(tmp_path / "bad.rrd")
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(InputError, match="no display for a window; add --web"):
        show(tmp_path / "bad.rrd")
