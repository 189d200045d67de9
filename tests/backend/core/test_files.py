"""A file is complete or absent, whenever the process is killed."""

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from touchdown.backend.core import files
from touchdown.backend.core.files import write_atomically

OLD, NEW = b"old" * 1000, b"new" * 5000

# Counts the lines that run inside files.py and kills the process, as kill -9 does, at the n-th.
CHILD = """
import os, signal, sys
from pathlib import Path
from touchdown.backend.core import files

left = int(sys.argv[2])

def trace(frame, event, arg):
    global left
    if frame.f_code.co_filename != files.__file__:
        return None
    if event == "line":
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
    return trace

sys.settrace(trace)
files.write_atomically(Path(sys.argv[1]), b"new" * 5000)
sys.settrace(None)
"""


def _killed_at(line: int, path: Path) -> bool:
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(path), str(line)],
        cwd=Path(files.__file__).parents[2],
        check=False,
    )
    assert done.returncode in (0, -signal.SIGKILL)
    return done.returncode != 0


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
@pytest.mark.parametrize("before", [OLD, None], ids=["replacing", "first"])
def test_killed_at_any_line_the_file_is_old_or_new(tmp_path, before):
    path, seen, line = tmp_path / "episode.mcap", [], 1
    while True:
        path.unlink(missing_ok=True)
        if before is not None:
            path.write_bytes(before)
        killed = _killed_at(line, path)
        content = path.read_bytes() if path.exists() else None
        assert content in (before, NEW)
        seen.append(content)
        if not killed:
            break
        line += 1
    assert line > 8, "the writing was never interrupted"
    assert seen[0] == before
    assert seen[-1] == NEW
    # Once new, never old again: the steps after the rename only make it durable.
    assert seen == sorted(seen, key=lambda content: content == NEW)


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_what_a_kill_left_behind_is_no_file_of_that_name_and_goes_with_the_next_write(tmp_path):
    path, line = tmp_path / "run.json", 1
    while not list(tmp_path.glob(".*.part")):
        assert _killed_at(line, path)
        line += 1
    assert list(tmp_path.glob("*.json")) == []
    write_atomically(path, NEW)
    assert [p.name for p in tmp_path.iterdir()] == ["run.json"]


def test_the_content_is_synced_before_the_rename_and_the_folder_after(tmp_path, monkeypatch):
    steps = []
    fsync, replace = os.fsync, Path.replace

    def spy_fsync(descriptor):
        folder = stat.S_ISDIR(os.fstat(descriptor).st_mode)
        steps.append("folder synced" if folder else "content synced")
        fsync(descriptor)

    def spy_replace(self, target):
        steps.append("renamed")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", spy_fsync)
    monkeypatch.setattr(Path, "replace", spy_replace)
    write_atomically(tmp_path / "a", NEW)
    assert steps == ["content synced", "renamed", "folder synced"]


def test_a_failed_write_keeps_the_old_content(tmp_path, monkeypatch):
    path = tmp_path / "a"
    write_atomically(path, OLD)

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, NEW)
    assert path.read_bytes() == OLD


def test_missing_folders_are_made(tmp_path):
    write_atomically(tmp_path / "a" / "b" / "c", b"")
    assert (tmp_path / "a" / "b" / "c").read_bytes() == b""
