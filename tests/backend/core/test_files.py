"""Files are complete or absent, and text of others is refused in one short sentence."""

from __future__ import annotations

import json
import os
import re
import signal
import stat
import subprocess
import sys
import threading
from contextlib import suppress
from copy import copy
from pathlib import Path

import pytest

import touchdown
from tests.backend.annotations.conftest import context_for, small_episode
from touchdown.backend.annotations import Dataset, Label, read_run_info
from touchdown.backend.annotations.backups import check_backup
from touchdown.backend.annotations.geometry_records import GeometryStore
from touchdown.backend.annotations.operation_log import read_journal
from touchdown.backend.annotations.storage import ReadOnlyFolderError
from touchdown.backend.bench.emulator_registry import recorded
from touchdown.backend.calibration.records import read_record
from touchdown.backend.cli.command_line import main
from touchdown.backend.cli.settings import load_method
from touchdown.backend.config import load_lab, load_simulation
from touchdown.backend.core import files
from touchdown.backend.core.faults import MAX_MESSAGE, InputError, RefusedError
from touchdown.backend.core.files import MAX_DEPTH, parse_json, parse_toml, write_atomically
from touchdown.backend.emulation.fault_plan import load_faults
from touchdown.backend.exchange import read_coco, read_manifest
from touchdown.backend.exchange.imports import read_foreign
from touchdown.backend.geometry.pieces import read_piece
from touchdown.backend.learning import load_card, load_samples
from touchdown.backend.runs import read_campaign, read_events
from touchdown.backend.runs.recorder import keep_photo
from touchdown.backend.sensing import read_pictures

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


def nested(levels: int) -> str:
    return "[" * levels + "]" * levels


def test_depth_is_counted_and_brackets_within_text_are_not():
    assert parse_json(nested(MAX_DEPTH)) is not None
    assert parse_json(json.dumps([nested(1000)] * 3)) == [nested(1000)] * 3
    assert len(parse_json("[" + ",".join(["[]"] * 1000) + "]")) == 1000
    for levels in (MAX_DEPTH + 1, 100_000):
        with pytest.raises(ValueError, match="nested deeper than 64 levels"):
            parse_json(nested(levels))
        with pytest.raises(ValueError, match="nested deeper than 64 levels"):
            parse_json('{"a":' * levels + "1" + "}" * levels)
    with pytest.raises(ValueError, match="nested deeper"):
        parse_toml("a." * 5_000 + "a = 1")


READERS = {
    "journal.jsonl": lambda path: list(read_journal(path)),
    "annotations.json": lambda path: list(read_coco(path, None)),
    "dataset.json": lambda path: Dataset.open(path.parent, write=False),
    "manifest.json": lambda path: read_manifest(path.parent),
    "run.json": lambda path: read_run_info(path.parent),
    "campaigns/c.json": lambda path: read_campaign(path.parent.parent, "c"),
    "samples.json": lambda path: load_samples(path.parent),
    "calibration.json": read_record,
    "model.json": load_card,
    "hash.json": lambda path: GeometryStore(path.parent).read("hash"),
    "events.jsonl": lambda path: list(read_events(path.parent)),
    "lab.toml": load_lab,
    "method.toml": load_method,
    "bench.toml": load_simulation,
    "faults.toml": load_faults,
    "piece.toml": read_piece,
}


@pytest.mark.promise("D8")
@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("what", ["deep", "deep arrays", "no text"])
def test_foreign_text_is_refused_shortly(name, what, tmp_path):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    is_toml = name.endswith("toml")
    deep = b'{"a":' * 5000 + b"1" + b"}" * 5000
    content = {
        "deep": b"a." * 5000 + b"a = 1" if is_toml else deep,
        "deep arrays": (b"a = " if is_toml else b"") + nested(5000).encode(),
        "no text": (b"a = 1 # " if is_toml else b'{"') + b"\xff" + b"secret " * 2000,
    }[what]  # fmt: skip
    path.write_bytes(content + b"\n")
    with pytest.raises((InputError, ValueError)) as refused:
        READERS[name](path)
    assert isinstance(refused.value, InputError) or name == "journal.jsonl"
    assert len(str(refused.value)) < 1000
    assert "secret" not in str(refused.value)


READ_WHOLE = {
    "method.toml": load_method,
    "backup.db": check_backup,
    "picture.png": lambda path: list(read_pictures(path)),
    "film.mp4": lambda path: list(read_pictures(path)),
    "still.png": recorded,
    "photo.png": lambda path: keep_photo(path.parent, 1, path),
    "bag.mcap": lambda path: list(read_foreign("contents", path)),
}


@pytest.mark.parametrize("name", READ_WHOLE)
def test_a_pipe_is_refused_before_it_is_opened(name, tmp_path):
    pipe, done = tmp_path / name, threading.Event()
    os.mkfifo(pipe)

    def end_each_reading():
        while not done.wait(0.02):
            with suppress(OSError):  # nobody reads
                os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))

    thread = threading.Thread(target=end_each_reading)
    thread.start()
    try:
        with pytest.raises(InputError, match="This is not a file") as refused:
            READ_WHOLE[name](pipe)
    finally:
        done.set()
        thread.join()
    assert refused.value.where == str(pipe)


def test_a_message_is_bounded():
    error = InputError("x" * 100_000, "here", "Do this.")
    # As between processes; an error that cannot be passed leaves the pool of a worker hanging.
    for one in (error, ReadOnlyFolderError(Path("data"), OSError("full"))):
        passed = copy(one)
        assert (str(passed), passed.what, passed.where) == (str(one), one.what, one.where)
    assert len(error.what) < MAX_MESSAGE + 10
    assert str(error).endswith("[here] Do this.")


def test_a_dataset_of_a_newer_program_is_not_written_and_names_it(tmp_path):
    with Dataset.open(tmp_path) as dataset:
        dataset.record(
            small_episode(), Label(1, 2), source="commanded", context=context_for(dataset)
        )
    path = tmp_path / "dataset.json"
    changes = {"schema_version": 99, "created_by": "touchdown 9.9", "home": "elsewhere:/moved"}
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    before = path.read_bytes()
    with Dataset.open(tmp_path) as newer:
        assert not newer.writable
        assert "was written by touchdown 9.9 (schema 99)" in newer.notices[0]
        assert len(newer.episodes()) == 1
        with pytest.raises(RefusedError, match="reading only"):
            newer.labels.set("ann", newer.episodes()[0].uuid, Label(3, 4))
    assert path.read_bytes() == before


@pytest.mark.parametrize("wrong", ["99", 1e300, True, None])
def test_a_schema_that_is_no_whole_number_is_refused(tmp_path, wrong):
    Dataset.open(tmp_path).close()
    path = tmp_path / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"schema_version": wrong}))
    with pytest.raises(InputError, match="description"):
        Dataset.open(tmp_path)


def test_an_empty_catalogue_is_named_with_its_remedy(tmp_path):
    Dataset.open(tmp_path).close()
    for path in tmp_path.glob("catalog.db*"):
        path.unlink()
    (tmp_path / "catalog.db").touch()
    with pytest.raises(InputError, match=r"catalogue is empty.*dataset rebuild"):
        Dataset.open(tmp_path, write=False)


def test_the_program_names_its_version_and_the_hash_of_its_sources(tmp_path):
    version, _, digest = files.program_version().partition("+")
    assert version == touchdown.__version__
    assert re.fullmatch("[0-9a-f]{16}", digest)
    assert files.program_stamp() == f"touchdown {version}+{digest}"
    one, two = tmp_path / "a.py", tmp_path / "b.py"
    one.write_text("x = 1\n")
    two.write_text("y = 1\n")
    before = files.hash_files([one, two], tmp_path)
    assert files.hash_files([two, one], tmp_path) == before
    two.write_text("y = 2\n")
    assert files.hash_files([one, two], tmp_path) != before
    two.rename(tmp_path / "c.py")
    assert files.hash_files([one, tmp_path / "c.py"], tmp_path) != before


def test_a_missing_package_of_an_extra_is_named_with_its_line():
    with pytest.raises(InputError, match="'no_such_package' is not installed") as caught:
        files.require_package("no_such_package.part", "cad")
    assert "pip install 'touchdown[cad]'" in caught.value.fix


def test_an_account_without_a_name_or_a_home_is_one_error(tmp_path, monkeypatch, capsys):
    def unknown(number: object) -> None:
        raise KeyError(number)

    for name in ("LOGNAME", "USER", "LNAME", "USERNAME", "HOME", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", unknown)
    words = ["collect", "--count", "1", "--dataset", str(tmp_path / "probes")]
    assert main(words) == 2
    assert "This account has no name." in capsys.readouterr().err
    monkeypatch.delenv("TOUCHDOWN_DATA", raising=False)
    assert main(["dataset"]) == 2
    assert "The home folder of this account is unknown." in capsys.readouterr().err


def test_a_data_folder_may_start_with_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("TOUCHDOWN_DATA", "~/probes")
    assert files.data_folder() == tmp_path / "probes"
