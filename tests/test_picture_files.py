"""Pictures of the documents survive a disk that takes no more of them."""

from pathlib import Path

import pytest

from tests import pictures, screens
from tests.picture_files import PictureFiles, run_reporting


@pytest.fixture
def files(tmp_path):
    (tmp_path / "stack.png").write_bytes(b"old")
    return PictureFiles(tmp_path)


def names(folder):
    return sorted(one.name for one in folder.iterdir())


def test_a_picture_is_there_when_all_are(files, tmp_path):
    files.keep("stack", b"new")
    files.keep("train", b"new")
    assert (tmp_path / "stack.png").read_bytes() == b"old"
    files.put()
    assert (tmp_path / "stack.png").read_bytes() == b"new"
    assert names(tmp_path) == ["stack.png", "train.png"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no disk that is always full here")
def test_a_full_disk_leaves_the_pictures_and_says_one_line(files, tmp_path, capsys):
    (tmp_path / "train.png.part").symlink_to("/dev/full")

    def draw():
        files.keep("stack", b"new")
        files.keep("train", b"new")
        raise AssertionError("the disk took it")

    assert run_reporting(draw) == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert "older ones are unchanged" in line
    assert "No space left on device" in line
    assert (tmp_path / "stack.png").read_bytes() == b"old"
    assert names(tmp_path) == ["stack.png"]


@pytest.mark.parametrize("program", [pictures, screens])
def test_a_folder_that_cannot_be_written_is_reported_before_anything_is_drawn(
    program, tmp_path, capsys
):
    (tmp_path / "file").write_text("no folder")
    assert program.main(["--out", str(tmp_path / "file" / "img")]) == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert str(tmp_path / "file") in line


def test_a_bug_shows_its_trace(capsys):
    assert run_reporting(lambda: 1 // 0) == 1
    assert "ZeroDivisionError" in capsys.readouterr().out
