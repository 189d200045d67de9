"""The device wizard: what is in sight is chosen and saved into the lab file."""

import errno
import os
import shutil
import sys
from functools import partial
from pathlib import Path

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QComboBox, QFileDialog, QLabel, QScrollArea

from tests.app.conftest import settle
from tests.backend.rig.scripted import scripted
from touchdown.app import shell
from touchdown.app.__main__ import parser as start_parser
from touchdown.app.connect.devices import FIELDS, LEFT, RIGHT
from touchdown.app.start import command_with_bench, open_bench
from touchdown.backend import devices
from touchdown.backend.config import BenchDescription, load_lab
from touchdown.backend.core import InputError
from touchdown.backend.rig.connection import BenchConnection
from touchdown.backend.runs import RunState

NUMBERS = ("2D8Y-69GR", "AAAA-1111")
LAB = """\
version = 1
name = "Bench 2"
kind = "hardware"

[melfa]   # ask Ann before it moves
host = "192.168.0.20"

[ft]
driver = "dynpick"
address = "/dev/serial/by-id/left-behind"

[gelsight]
by_id = "{0}/none"
names = "{0}/names"
left = {{ serial = "AAAA-1111" }}   # thumb
"""


@pytest.fixture
def file(tmp_path):
    for number, serial in enumerate(NUMBERS):
        card = tmp_path / "names" / f"video{number}"
        card.mkdir(parents=True)
        (card / "index").write_text("0\n")
        (card / "name").write_text(f"GelSight Mini R0B {serial}\n")
    made = tmp_path / "lab.toml"
    made.write_text(LAB.format(tmp_path), "utf-8")
    return made


@pytest.fixture
def wizard(main, bench, file):
    """The form of a bench whose devices are not connected, as the operator opens it."""
    bench.connection, bench.name = BenchConnection(scripted()[0]), "Bench 2"
    bench.description, bench.simulated = BenchDescription(mode="hardware"), False
    bench.limits_source = str(file)
    main.attach(bench)
    main.panels.connect.sheet.devices.click()
    yield main.panels.connect.devices.sheet
    bench.connection.close()


def write(sheet, key, text):
    editor = sheet.editors[key]
    editor.setFocus()
    editor = editor.lineEdit() if isinstance(editor, QComboBox) else editor
    editor.selectAll()
    QTest.keyClicks(editor, text)


def test_it_shows_the_file_and_offers_what_is_in_sight(wizard):
    assert wizard.isVisible()
    assert set(wizard.values()) == {field.key for field in FIELDS}
    shown = wizard.values()
    assert shown["ft.address"] == "/dev/serial/by-id/left-behind"
    assert (shown[LEFT], shown[RIGHT]) == ("AAAA-1111", "")
    box = wizard.editors[RIGHT]
    assert [box.itemText(i) for i in range(box.count())] == list(NUMBERS)
    makes = wizard.editors["ft.driver"]
    assert {"dynpick", "bota", "netft"} <= {makes.itemText(i) for i in range(makes.count())}
    assert "2D8Y-69GR, AAAA-1111" in wizard.said.text()
    assert all(editor.accessibleName() for editor in wizard.editors.values())


def test_what_is_chosen_is_saved_and_the_rest_of_the_file_stays(wizard, file):
    write(wizard, RIGHT, "2D8Y-69GR")
    wizard.swap.click()
    write(wizard, "ft.driver", "bota")
    write(wizard, "wsg.port", "1001")
    QTest.mouseClick(wizard.save, Qt.MouseButton.LeftButton)
    assert wizard.said.text().startswith("Saved.")
    settings = load_lab(file).settings
    assert (settings.gelsight.left.serial, settings.gelsight.right.serial) == NUMBERS
    assert (settings.ft.driver, settings.wsg.port) == ("bota", 1001)
    text = file.read_text("utf-8")
    assert "# ask Ann before it moves" in text
    assert 'left = { serial = "2D8Y-69GR" }   # thumb' in text
    wizard.save.click()
    assert wizard.said.text() == "Nothing is changed."


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        (RIGHT, "AAAA-1111", "Both fingers have the same camera."),
        ("wsg.port", "soon", "Gripper, port: write a number."),
        ("wsg.port", "70000", "wsg.port"),
        ("melfa.host", "127.0.0.1", "melfa.host"),
        ("ft.driver", "dynapick", "There is no 'dynapick' here: use one of dynpick, leptrino"),
    ],
)
def test_what_cannot_be_used_is_said_and_not_saved(wizard, file, key, text, said):
    before = file.read_text("utf-8")
    write(wizard, key, text)
    wizard.save.click()
    assert said in wizard.said.text()
    assert file.read_text("utf-8") == before


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of the size of files")
def test_a_disk_that_takes_no_more_is_said_and_the_file_stays_as_it_was(wizard, file):
    import resource

    before, (soft, hard) = file.read_text("utf-8"), resource.getrlimit(resource.RLIMIT_FSIZE)
    write(wizard, "wsg.port", "1001")
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        wizard.save.click()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert wizard.said.text().startswith("The file cannot be written:")
    assert file.read_text("utf-8") == before
    assert [one.name for one in file.parent.iterdir() if one.is_file()] == [file.name]
    wizard.save.click()
    assert wizard.said.text().startswith("Saved.")
    assert load_lab(file).settings.wsg.port == 1001


@pytest.mark.skipif(sys.platform == "win32", reason="a pipe under a name")
def test_looking_opens_no_port_so_that_none_can_hold_it_up_or_answer_wrongly(
    wizard, file, tmp_path, monkeypatch
):
    # Whoever opens this one waits for a writer that never comes.
    ports = tmp_path / "by-id"
    ports.mkdir()
    os.mkfifo(ports / "usb-Silent")
    monkeypatch.setattr(devices, "choices", partial(devices.choices, ports=ports))
    (tmp_path / "names" / "video0" / "name").write_bytes(b"\xff\x00GelSight?")
    wizard.look.click()
    offered = wizard.editors["ft.address"]
    assert [offered.itemText(i) for i in range(offered.count())] == [str(ports / "usb-Silent")]
    assert "cameras AAAA-1111;" in wizard.said.text()


def test_nothing_found_says_what_to_do(wizard, main, bench, file, tmp_path, monkeypatch):
    shutil.rmtree(tmp_path / "names")
    monkeypatch.setattr(devices, "choices", partial(devices.choices, ports=tmp_path / "none"))
    wizard.look.click()
    assert "then press Look again" in wizard.said.text()
    assert (wizard.look.property("role"), wizard.save.property("role")) == ("primary", "")
    bench.description = BenchDescription(mode="emulated")
    wizard.look.click()
    assert "emulated: there is nothing to search for" in wizard.said.text()
    assert (wizard.look.property("role"), wizard.save.property("role")) == ("", "primary")


def test_the_sheet_leaves_stop_free_in_a_low_window(wizard) -> None:
    wizard.parentWidget().resize(1280, 720)
    wizard.resize_to_em(48, 60)
    assert wizard.height() <= wizard.parentWidget().height() - 128


def test_all_rows_show_in_a_window_of_1280x720(wizard):
    wizard.parentWidget().resize(1280, 720)
    wizard.resize_to_em(48, 60)
    QApplication.processEvents()
    scroll = next(s for s in wizard.findChildren(QScrollArea) if s.widget() is wizard._form)
    assert scroll.verticalScrollBar().maximum() == 0
    host, port = wizard.editors["wsg.host"], wizard.editors["wsg.port"]
    assert (host.geometry().top(), host.width() > port.width()) == (port.geometry().top(), True)


def test_start_again_opens_the_saved_file_in_a_new_program(wizard, main, file, tmp_path):
    write(wizard, "wsg.host", "192.168.0.31")
    wizard.save.click()
    assert wizard.said.text() == "Saved. Restart to use it."
    assert [one.property("role") for one in (wizard.again, wizard.save)] == ["primary", ""]
    wizard.again.click()
    assert main.cards.asks.text.startswith("Restart the program with lab.toml?")
    main.cards.asks.answers[0][1]()
    assert main.next_bench is None
    main.cards.asks.answers[1][1]()
    assert main.next_bench == file
    assert not main.window.isVisible()
    args = start_parser().parse_args(["--bench=old.toml", "--inject=x", "--notify=call me"])
    command = command_with_bench(file, args)
    assert command == [
        sys.executable,
        "-m",
        "touchdown",
        "app",
        f"--bench={file}",
        "--notify=call me",
    ]
    assert start_parser().parse_args(command[4:]).bench == file


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('version = 7\nkind = "hardware"', "Bad value for 'version': 7 is not known here"),
        ('version = 1\n[melfa]\nhots = "a"', "hots"),
        ("press_mm = 1", "press_mm"),
        ("[melfa", "not valid TOML"),
    ],
)
def test_a_bench_file_is_refused_in_the_words_of_the_command_line(live, tmp_path, content, said):
    file = tmp_path / "bench.toml"
    file.write_text(content)
    with pytest.raises(InputError) as refused:
        open_bench(file)
    live.open_bench(file)
    text = live.cards.card("BENCH-FILE").text
    assert said in text.what
    assert (text.what, text.next_step) == (refused.value.what, refused.value.fix)
    assert live.cards.asks is None
    assert live.next_bench is None


def test_a_bench_in_use_is_not_exchanged(live, bench, file):
    live.window.rail["bench"].click()
    (dialog,) = live.window.findChildren(QFileDialog)
    dialog.fileSelected.emit(str(file))
    bench.set_state(RunState.RUNNING)
    live.cards.asks.answers[1][1]()
    assert "BENCH-IN-USE" in live.cards.codes
    live.cards.withdraw()
    live.open_bench(file)
    assert live.cards.asks is None
    assert live.next_bench is None
    assert live.window.isVisible()
    bench.set_state(RunState.IDLE)
    live.actions.action("connect").trigger()
    assert "Ctrl+Shift+B opens a bench file" in live.window._message.text()


def unreadable(monkeypatch, file):
    monkeypatch.setattr(Path, "read_bytes", lambda path: raise_it(PermissionError(13, "denied")))
    file.write_text("")


def raise_it(error):
    raise error


BAD_FILES = {
    "a folder": (lambda patch, file: file.mkdir(), "This is not a file."),
    "a pipe": (lambda patch, file: os.mkfifo(file), "This is not a file."),
    "a large file": (
        lambda patch, file: os.truncate(os.open(file, os.O_CREAT | os.O_RDWR), 2**31),
        "The file is too large: more than 1 MB.",
    ),
    "bytes": (
        lambda patch, file: file.write_bytes(bytes(range(255, 0, -1))),
        "The file is not valid TOML: byte 0 is not text in UTF-8.",
    ),
    "no file": (lambda patch, file: None, "Cannot read the file: No such file or directory."),
    "no right to read": (unreadable, "Cannot read the file: denied."),
}


@pytest.mark.parametrize("kind", BAD_FILES)
def test_what_is_no_bench_file_is_refused_before_the_question(live, tmp_path, monkeypatch, kind):
    make, said = BAD_FILES[kind]
    (tmp_path / "earlier.toml").write_text("press_mm = 1")
    live.open_bench(tmp_path / "earlier.toml")
    file = tmp_path / "bench.toml"
    make(monkeypatch, file)
    live.open_bench(file)
    shown = live.cards.card("BENCH-FILE")
    assert (shown.text.what, shown.count) == (said, 1)
    texts = [label.text() for label in shown.findChildren(QLabel)]
    assert any(str(file) in text for text in texts)
    assert not any("earlier.toml" in text for text in texts)
    assert live.cards.asks is None
    assert live.window.isVisible()


def test_a_file_that_goes_between_question_and_restart_leaves_the_bench(live, file):
    live.open_bench(file)
    file.unlink()
    live.cards.asks.answers[1][1]()
    assert "No such file" in live.cards.card("BENCH-FILE").text.what
    assert (live.next_bench, live.window.isVisible()) == (None, True)
    file.write_text("version = 1")
    live.cards.clear(["BENCH-FILE"])
    file.write_text("")
    live.open_bench(file)
    assert "BENCH-FILE" not in live.cards.codes
    live.cards.asks.answers[1][1]()
    assert (live.next_bench, live.window.isVisible()) == (file, False)


@pytest.mark.parametrize("again", ["answer", "Ctrl+Q"])
def test_settings_that_a_full_disk_refuses_hold_the_window_once(live, monkeypatch, again):
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(shell, "save_settings", lambda path, told: raise_it(full))
    live.window.close()
    settle(live)
    assert "No space left" in live.cards.card("BUG-OSERROR").text.what
    assert live.cards.asks.text.startswith("The window settings cannot be saved.")
    assert live.window.isVisible()
    (live.cards.asks.answers[1][1] if again == "answer" else live.window.close)()
    assert not live.window.isVisible()
    assert live.next_bench is None


def test_settings_that_a_full_disk_refuses_hold_the_restart(live, file, monkeypatch):
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(shell, "save_settings", lambda path, told: raise_it(full))
    live.open_bench(file)
    live.cards.asks.answers[1][1]()
    settle(live)
    assert "No space left" in live.cards.card("BUG-OSERROR").text.what
    assert live.cards.asks.text.startswith("The window settings cannot be saved.")
    assert (live.next_bench, live.window.isVisible()) == (None, True)
    live.cards.asks.answers[1][1]()
    assert (live.next_bench, live.window.isVisible()) == (file, False)
