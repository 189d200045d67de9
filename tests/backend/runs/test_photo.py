"""Photos of a trial: none is overwritten, and a full disk leaves no partial file."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from touchdown.backend.core.faults import InputError
from touchdown.backend.runs.recorder import keep_photo

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "picture.PNG"
    path.write_bytes(PNG + b"first")
    return path


def test_a_picture_that_was_taken_away_leaves_the_others_in_place(
    tmp_path: Path, picture: Path
) -> None:
    first, second = (keep_photo(tmp_path / "run", 3, picture) for _ in range(2))
    first.unlink()
    picture.write_bytes(PNG + b"third")
    third = keep_photo(tmp_path / "run", 3, picture)
    assert (second.name, third.name) == ("trial-003-2.png", "trial-003-3.png")
    assert second.read_bytes() == PNG + b"first"
    assert third.read_bytes() == PNG + b"third"


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_is_said_and_leaves_nothing(
    tmp_path: Path, picture: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    kept = keep_photo(tmp_path / "run", 3, picture)

    def full(*_args: object, **_named: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os if call == "fsync" else Path, call, full)
        with pytest.raises(InputError, match="No space left") as caught:
            keep_photo(tmp_path / "run", 3, picture)
    assert caught.value.where == str(picture)
    assert sorted(kept.parent.iterdir()) == [kept]
    assert keep_photo(tmp_path / "run", 3, picture).name == "trial-003-2.png"
