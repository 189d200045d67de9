"""Doctor: each finding with its fix, one JSON object, exit code 1 only for what stops work."""

import errno
import io
import json
import os
import re
import shutil
import zipfile
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path

import pytest

from touchdown.backend.cli.command_line import main
from touchdown.backend.cli.doctor import command
from touchdown.backend.cli.doctor.command import DoctorCheck
from touchdown.backend.cli.doctor.problem_report import write_report
from touchdown.backend.cli.doctor.qt_libraries import PACKAGES, missing_in, packages_for
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.core import InputError, program_stamp

WRITTEN = Path(__file__).parents[3] / "data" / "written_0_1"


def _run(monkeypatch, *checks, as_json=True):
    monkeypatch.setattr(command, "EXAMINATIONS", tuple(lambda c=c: c for c in checks))
    for look in command.EXAMINATIONS:
        look.__name__ = "check_something"
    stream = io.StringIO()
    code = command.run(
        Namespace(bench=None, dataset=None, bundle=None, with_pictures=False, with_names=False),
        VerbOutput(json=as_json, stream=stream),
    )
    return code, stream.getvalue()


GOOD, NOTE = DoctorCheck("a", True, "fine"), DoctorCheck("b", True, "none", "plug it in")
BAD = DoctorCheck("c", False, "broken [x]", "mend it")


def test_only_what_stops_work_fails_and_people_see_words_and_fixes(monkeypatch):
    code, shown = _run(monkeypatch, GOOD, NOTE)
    assert code == 0
    assert json.loads(shown)["checks"] == [asdict(GOOD), asdict(NOTE)]
    code, shown = _run(monkeypatch, GOOD, NOTE, BAD, as_json=False)
    assert code == 1
    for word in ("OK", "NOTE", "FAIL", "broken [x]", "mend it", "1 to fix"):
        assert word in shown


def test_a_damaged_installation_does_not_end_the_doctor(monkeypatch):
    def check_data_folder():
        raise ImportError("no numpy")

    monkeypatch.setattr(command, "EXAMINATIONS", (check_data_folder, lambda: GOOD))
    stream = io.StringIO()
    screen = VerbOutput(json=True, stream=stream)
    assert (
        command.run(
            Namespace(bench=None, dataset=None, bundle=None, with_pictures=False, with_names=False),
            screen,
        )
        == 1
    )
    first, second = json.loads(stream.getvalue())["checks"]
    assert (first["name"], first["ok"], first["fix"]) == ("data folder", False, "make setup")
    assert second["ok"]


@pytest.mark.slow
def test_on_this_computer(capsys):
    code = main(["doctor", "--json"])
    checks = json.loads(capsys.readouterr().out)["checks"]
    names = [check["name"] for check in checks]
    assert len(set(names)) == len(names) == len(command.EXAMINATIONS)
    assert all(check["fix"] for check in checks if not check["ok"])
    found = {check["name"]: check for check in checks}
    assert re.match(r"CPython 3\.1\d", found["python"]["detail"])
    for needed in ("python", "qt", "qt platform", "opencv", "torch", "packages", "data folder"):
        assert found[needed]["ok"], found[needed]
    assert code == (0 if all(check["ok"] for check in checks) else 1)


@pytest.mark.parametrize(
    ("qt", "python", "fit"),
    [
        ("6.12.0", (3, 11), False),
        ("6.12.0", (3, 12), False),
        ("6.9.1", (3, 13), False),
        ("6.9.2", (3, 11), True),
        ("6.8.0", (3, 11), True),
        ("6.11.3", (3, 11), True),
        ("6.11.3", (3, 13), True),
        ("6.7.3", (3, 11), False),
        ("7.0.0", (3, 13), False),
    ],
)
def test_pairs_of_qt_and_python(qt, python, fit):
    assert (command.qt_pair_fault(qt, python) == "") is fit


VERSIONS = {
    "PySide6-Essentials": "6.11.3",
    "shiboken6": "6.11.3",
    "pyqtgraph": "0.14.0",
    "opencv-contrib-python-headless": "5.0.0.93",
    "torch": None,
}


@pytest.mark.parametrize(
    ("changed", "look", "word"),
    [
        ({"pyqtgraph": None}, "check_qt_versions", "pyqtgraph"),
        ({"shiboken6": "6.10.0"}, "check_qt_versions", "shiboken6 6.10.0"),
        ({"PySide6": "6.11.3"}, "check_qt_versions", "mixed"),
        ({"opencv-python": "4.10"}, "check_opencv", "opencv-python"),
        ({"opencv-contrib-python-headless": None}, "check_opencv", "not installed"),
        ({}, "check_torch", "not installed"),
        ({"numpy": None}, "check_others", "missing"),
    ],
)
def test_wrong_packages_are_named_with_the_fix(monkeypatch, changed, look, word):
    versions = {**VERSIONS, **changed}
    monkeypatch.setattr(command, "package_version", lambda name: versions.get(name) or "")
    check = getattr(command, look)()
    assert not check.ok
    assert word in check.detail
    assert "pip" in check.fix


def test_good_packages_are_good(monkeypatch):
    monkeypatch.setattr(command, "package_version", VERSIONS.get)
    assert command.check_qt_versions() == DoctorCheck("qt", True, "PySide6-Essentials 6.11.3")
    assert command.check_opencv().ok


def test_an_installation_without_qt_is_complete_and_names_the_extra(monkeypatch):
    monkeypatch.setattr(command, "package_version", {}.get)
    check = command.check_qt_versions()
    assert (check.ok, check.fix) == (True, 'pip install "touchdown[app]"')
    assert command.check_qt_platform().ok


@pytest.mark.parametrize("look", [command.check_torch, command.check_qt_platform])
def test_a_computer_too_busy_to_answer_is_not_told_to_install_anew(monkeypatch, look):
    monkeypatch.setattr(command, "CHILD_LIMIT_S", 0)
    check = look()
    assert not check.ok
    assert "no answer within 0 s" in check.detail
    assert "busy" in check.fix
    assert "install" not in check.fix


LDD = """libqxcb.so:
\tlinux-vdso.so.1 (0x00007ffd)
\tlibxcb-cursor.so.0 => not found
\tlibxcb-icccm.so.4 => not found
\tlibm.so.6 => /lib/x86_64-linux-gnu/libm.so.6 (0x00007f)
./libqxcb.so: /lib/libc.so.6: version `GLIBC_2.99' not found (required by ./libqxcb.so)
libqoffscreen.so:
\tlibxcb-cursor.so.0 => not found
"""


def test_missing_libraries_are_read_from_ldd_and_become_packages():
    assert packages_for(["libunknown.so.7"]) == []
    assert packages_for(["libgthread-2.0.so.0", "libglib-2.0.so.0"]) == ["libglib2.0-0"]
    assert all(re.fullmatch(r"[a-z0-9.+-]+", package) for package in PACKAGES.values())


def test_missing_libraries_give_the_apt_line(monkeypatch):
    monkeypatch.setattr(command, "missing_libraries", lambda: missing_in(LDD))
    fix = "sudo apt-get install libxcb-cursor0 libxcb-icccm4"
    missing = "missing: libxcb-cursor.so.0, libxcb-icccm.so.4"
    assert command.check_qt_libraries() == DoctorCheck("qt libraries", False, missing, fix)


def test_cameras_are_listed_once_each(tmp_path):
    for name in ("usb-GelSight_A-video-index0", "usb-GelSight_A-video-index1", "other"):
        (tmp_path / name).touch()
    assert command.check_cameras(tmp_path).detail == "usb-GelSight_A-video-index0"
    none = command.check_cameras(tmp_path / "missing")
    assert none.ok
    assert none.fix


def test_a_data_folder_that_cannot_be_written_is_named(tmp_path):
    blocked = tmp_path / "file"
    blocked.touch()
    check = command.check_data_folder(blocked / "data")
    assert not check.ok
    assert str(blocked) in check.detail
    assert "TOUCHDOWN_DATA" in check.fix
    good = command.check_data_folder(tmp_path / "data")
    assert good.ok
    assert list((tmp_path / "data").iterdir()) == []


def test_a_full_disk_fails(tmp_path, monkeypatch):
    assert command.check_disk(tmp_path / "not" / "yet").ok
    monkeypatch.setattr(command, "LEAST_FREE_GB", 1e9)
    assert not command.check_disk(tmp_path).ok


def test_no_display_is_no_failure_but_has_a_way_out(monkeypatch):
    monkeypatch.setattr(command.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    check = command.check_display()
    assert check.ok
    assert "make demo" in check.fix
    monkeypatch.setenv("DISPLAY", ":0")
    assert command.check_display() == DoctorCheck("display", True, "X11 :0")


def test_missing_models_are_named(tmp_path):
    (tmp_path / "pot.safetensors").touch()
    (tmp_path / "barrel.json").touch()
    check = command.check_models(tmp_path)
    assert (check.ok, check.fix) == (False, "make models")
    assert check.detail == "missing for mushroom, barrel"
    assert not command.check_models(tmp_path / "no such folder").ok
    for piece in ("mushroom", "barrel"):
        (tmp_path / f"{piece}.safetensors").touch()
    assert command.check_models(tmp_path).ok


JOURNAL = (
    '{"format":1,"program":"touchdown"}\n'
    '{"kind":"RunStarted","settings":"{\\"person\\": \\"J\\\\u00fcrgen K\\", \\"path\\": '
    '\\"HOME/x\\", \\"note\\": \\"by\\\\nMarta\\"}"}\n'
    '{"kind":"EpisodeDecided","person":"Eve"}\n{"ki'
)


@pytest.fixture
def data_of_operator(monkeypatch, tmp_path):
    """Data and settings of an operator called Marta, in whose dataset Ann labels."""
    home = tmp_path / "marta"
    data, config = home / "data", home / "config"
    for folder in (
        data / "log",
        data / "runs" / "20260101-1",
        data / "runs" / "20260102-2",
        config,
    ):
        folder.mkdir(parents=True)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("LOGNAME", "marta")
    monkeypatch.setenv("TOUCHDOWN_DATA", str(data))
    monkeypatch.setenv("TOUCHDOWN_CONFIG", str(config))
    monkeypatch.setattr("platform.node", lambda: "BENCHPC7")
    shutil.unpack_archive(WRITTEN / "dataset.zip", data / "dataset")
    log = (
        f"INFO started in {data} on benchpc7\nann and J\u00fcrgen K approved, Annular ring; ann_2\n"
    )
    (data / "log" / "app.log").write_bytes(log.encode() + b"\xff\x00\x80 torn")
    (data / "log" / "app.log.1").symlink_to(data / "log" / "gone")
    (data / "log" / "app.log.2").mkdir()
    (config / "window.json").write_text('{"pages": {"collect": {"person": "Eve"}}, "theme')
    for run in ("20260101-1", "20260102-2"):
        text = JOURNAL.replace("HOME", str(home)).replace("Eve", f"Eve{run[-1]}")
        (data / "runs" / run / "journal.jsonl").write_text(text)
    (data / "runs" / "20260102-2" / "trial-1.jpg").write_bytes(b"\xff\xd8 a picture of Marta")
    return tmp_path


NAMES = re.compile(r"marta|j(\u00fc|\\+u00fc)rgen|\beve|\bann\b|ann_2|benchpc7", re.IGNORECASE)


def _report(folder, *options):
    out = folder / "out.zip"
    assert main(["doctor", "--bundle", str(out), *options]) == 0
    with zipfile.ZipFile(out) as archive:
        assert archive.testzip() is None
        return {name: archive.read(name) for name in archive.namelist()}


def test_a_problem_report_holds_no_names_and_no_pictures(monkeypatch, data_of_operator):
    monkeypatch.setattr(command, "EXAMINATIONS", (command.check_data_folder,))
    files = _report(data_of_operator)
    assert set(files) == {
        "README.txt", "doctor.json", "versions.json", "log/app.log", "run/journal.jsonl",
        "settings/window.json",
    }  # fmt: skip
    found = {name: NAMES.findall(raw.decode()) for name, raw in files.items()}
    assert found == {name: [] for name in files}
    assert str(data_of_operator) not in b"".join(files.values()).decode()
    assert "Not readable: log/app.log.1: No such file" in files["README.txt"].decode()
    log = files["log/app.log"].decode()
    known = r"INFO started in ~/data on <computer>\n(<person \d>) and <person \d> approved, Annular"
    assert re.match(known, log)
    assert "torn" in log
    assert json.loads(files["versions.json"])["program"] == program_stamp()
    assert json.loads(files["doctor.json"])["checks"][0]["detail"] == "~/data"
    assert len(files["run/journal.jsonl"].splitlines()) == 4
    with pytest.raises(InputError, match="exists already"):
        write_report(data_of_operator / "out.zip", {})
    monkeypatch.setattr(os, "fsync", _full)
    with pytest.raises(OSError, match="No space left"):
        write_report(data_of_operator / "full.zip", {})
    assert not list(data_of_operator.glob("*full*")), "the next try would be refused"


def _full(file):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_names_and_pictures_come_with_an_option_each(monkeypatch, data_of_operator):
    monkeypatch.setattr(command, "EXAMINATIONS", ())
    files = _report(data_of_operator, "--with-pictures")
    assert files["run/trial-1.jpg"].startswith(b"\xff\xd8")
    assert not NAMES.findall(files["run/journal.jsonl"].decode())
    (data_of_operator / "out.zip").unlink()
    files = _report(data_of_operator, "--with-names")
    assert b"Eve2" in files["run/journal.jsonl"]
    assert "run/trial-1.jpg" not in files
