"""Pictures of the documents survive a full disk, and ``make screens CHECK=1`` finds misfits."""

from pathlib import Path

import pytest
from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QPainter
from PySide6.QtWidgets import QApplication, QComboBox, QLabel, QPushButton, QWidget

from tests import pictures, screens
from tests.picture_files import PictureFiles, run_reporting
from tests.screen_check import PseudoTranslator, view_failures, window_texts
from touchdown.widgets.base import ElidedLabel, Panel, describe, label, scroll_area, tr


@pytest.fixture
def files(tmp_path):
    (tmp_path / "stack.png").write_bytes(b"old")
    return PictureFiles(tmp_path)


def names(folder):
    return sorted(one.name for one in folder.iterdir())


def test_a_picture_is_there_when_all_are(files, tmp_path):
    files.keep("stack.png", b"new")
    files.keep("train.png", b"new")
    assert (tmp_path / "stack.png").read_bytes() == b"old"
    files.put()
    assert (tmp_path / "stack.png").read_bytes() == b"new"
    assert names(tmp_path) == ["stack.png", "train.png"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no disk that is always full here")
def test_a_full_disk_leaves_the_pictures_and_says_one_line(files, tmp_path, capsys):
    (tmp_path / "train.png.part").symlink_to("/dev/full")

    def draw():
        files.keep("stack.png", b"new")
        files.keep("train.png", b"new")
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


class Painted(QWidget):
    def paintEvent(self, _event):  # noqa: N802
        painter = QPainter(self)
        painter.drawText(QRectF(5, 0, 60, 20), int(Qt.AlignmentFlag.AlignLeft), "0.25")
        painter.drawText(QRectF(15, 2, 60, 20), int(Qt.AlignmentFlag.AlignLeft), "0.50")
        painter.drawText(QRectF(0, 40, 30, 20), int(Qt.AlignmentFlag.AlignLeft), "1234.5 mm")


def test_the_check_of_the_screens_finds_what_does_not_fit(qtbot):
    window = QWidget()
    qtbot.addWidget(window)

    def put(widget, *place):
        widget.setParent(window)
        widget.setGeometry(*place)
        widget.show()
        return widget

    put(QLabel("wide enough"), 0, 0, 200, 30)
    assert view_failures_of(window) == []
    put(QLabel("146 mm"), 0, 40, 20, 30)
    put(QPushButton("Calibrate"), 0, 80, 20, 30)
    combo = put(QComboBox(), 0, 120, 40, 30)
    combo.addItem("pick-and-place")
    put(ElidedLabel("muted"), 0, 160, 60, 30).setText("trial 1 of 1, probe 12")
    put(QPushButton("Far"), 390, 0, 80, 30)
    put(QPushButton("One"), 100, 200, 80, 30)
    put(QPushButton("Two"), 150, 210, 80, 30)
    put(Painted(), 200, 100, 100, 100)
    inside = QPushButton("Reached by scrolling")
    inside.setMinimumSize(200, 600)
    put(scroll_area(inside), 100, 250, 280, 40)
    found = view_failures_of(window)
    for words in (
        "elided: 'trial 1 of 1, probe 12'", "cut off: QLabel '146 mm'", "cut off: QPushButton 'Cal",
        "'pick-and-place' needs", "off the screen: QPushButton 'Far' by 70 px",
        "overlap: QPushButton 'One' and QPushButton 'Two'", "overlap: painted '0.25' and '0.50'",
        "cut off: painted '1234.5 mm'",
    ):  # fmt: skip
        assert sum(words in line for line in found) == 1, (words, found)
    assert len(found) == 8


def view_failures_of(window):
    window.show()
    return view_failures(window, QSize(400, 300))


def test_texts_of_the_window_go_through_the_translation(qtbot):
    """Parts of ``widgets.base`` translate what they are given; fields keep their place and form."""
    assert {"Start stacking", "Press Start stacking to begin.", "Grip"} <= window_texts()
    translator, application = PseudoTranslator(), QApplication.instance()
    application.installTranslator(translator)
    try:
        button, panel = QPushButton(tr("Grip")), Panel("Run")
        for widget in (button, panel):
            qtbot.addWidget(widget)
        describe((button, "Start stacking", "not in the sources"))
        assert button.text() == "Gr\u00efp\u00f6\u00f6"
        assert button.accessibleName() == "St\u00e5rt st\u00e5\u00e7k\u00ef\u00f1g \u00fcnd "
        assert (button.toolTip(), panel.accessibleName()) == (
            "not in the sources",
            "R\u00fc\u00f1\u00f6",
        )
        assert label("").text() == ""
    finally:
        application.removeTranslator(translator)
    assert tr("{} of {:.1f} placed", 1, 2) == "1 of 2.0 placed"
