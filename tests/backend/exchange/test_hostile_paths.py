"""Names from outside that lead out of their folder: refused, and nothing is written or read there.

No archive is ever unpacked: what is imported and merged are folders.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import pytest

from touchdown.backend.annotations.reconciliation import copy_files
from touchdown.backend.core.faults import InputError
from touchdown.backend.exchange.manifest import MANIFEST_NAME, VERSION, read_manifest

ROOT = Path(__file__).resolve().parents[3]
HOSTILE = [
    "../secret",
    "a/../../secret",
    "/etc/hostname",
    "link/secret",
    "x" * 300,
    "a\0b",
    "",
]
UNPACKING = re.compile(r"import (zipfile|tarfile)|from (zipfile|tarfile)|unpack_archive")


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with a link that leads out of it, beside a file that is nobody's business."""
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret").write_bytes(b"secret")
    (inside / "link").symlink_to(tmp_path)
    return inside


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.promise("D7")
@pytest.mark.parametrize("name", HOSTILE)
def test_an_export_names_only_files_of_its_own(name: str, place: Path) -> None:
    listed = {"path": name, "bytes": 6, "sha256": hashlib.sha256(b"secret").hexdigest()}
    (place / MANIFEST_NAME).write_text(json.dumps({"version": VERSION, "files": [listed]}))
    with pytest.raises(InputError) as caught:
        read_manifest(place)
    assert str(place / MANIFEST_NAME) in str(caught.value)


@pytest.mark.promise("D7")
@pytest.mark.parametrize("name", HOSTILE)
def test_a_merge_writes_nothing_outside_its_dataset(name: str, place: Path, tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (tmp_path / "theirs" / "secret").write_bytes(b"other")
    before = snapshot(tmp_path)
    with pytest.raises(InputError, match="outside its dataset"):
        copy_files(place, theirs, [name])
    assert snapshot(tmp_path) == before


@pytest.mark.promise("D7")
def test_a_link_that_leads_out_of_the_other_dataset_is_not_followed(
    place: Path, tmp_path: Path
) -> None:
    (place / "raw").mkdir()
    with pytest.raises(InputError, match="outside its dataset"):
        copy_files(place / "raw", place, ["link/secret"])
    assert list((place / "raw").iterdir()) == []


@pytest.mark.promise("D7")
def test_no_archive_is_unpacked_anywhere() -> None:
    texts = {path: path.read_text() for path in (ROOT / "backend").rglob("*.py")}
    assert len(texts) > 100
    assert [path for path, text in texts.items() if UNPACKING.search(text)] == []
