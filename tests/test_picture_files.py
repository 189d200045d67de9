"""Pictures of the documents survive a full disk, and ``make screens CHECK=1`` finds misfits."""

import contextlib
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PySide6.QtCore import QRectF, QSize, Qt, QTranslator
from PySide6.QtGui import QPainter
from PySide6.QtWidgets import QApplication, QComboBox, QLabel, QPushButton, QWidget

from tests import pictures, screens
from tests.picture_files import PictureFiles, run_reporting
from tests.screen_check import (
    PseudoTranslator,
    counted_nouns,
    plain_words,
    untranslated,
    view_failures,
    window_texts,
    write_texts,
)
from touchdown.app.shell import stopped_card
from touchdown.app.stack.page import StackPage
from touchdown.app.train.page import TrainPage
from touchdown.backend.core import Outcome, SupportKind
from touchdown.widgets.base import (
    ElidedLabel,
    Panel,
    Theme,
    count_noun,
    describe,
    label,
    scroll_area,
    tr,
)
from touchdown.widgets.forms import LastProbePanel, ProbeText
from touchdown.widgets.lists import EpisodeTable, EpisodeTableRow, FigureTable
from touchdown.widgets.shell.devices import ChipValue, DeviceChip
from touchdown.widgets.shell.fault_cards import FaultCard
from touchdown.widgets.views import OffsetScene, OffsetView, Score, ScorePanel


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


@pytest.fixture
def translated(qtbot):
    """Install a translator for the test, and give each of its widgets to ``qtbot``."""
    with contextlib.ExitStack() as stack:

        def install(translator):
            application = QApplication.instance()
            application.installTranslator(translator)
            stack.callback(application.removeTranslator, translator)

        yield install


def test_texts_of_the_window_go_through_the_translation(qtbot, translated):
    """Parts of ``widgets.base`` translate what they are given; fields keep their place and form."""
    assert {"Start stacking", "Press Start stacking to begin.", "Grip"} <= window_texts()
    assert {"{} of {} placed", "press", "approved"} <= window_texts()
    assert {"CALIBRATE", "Ctrl+Return", "tactile_left"} & window_texts() == set()
    assert {"probe", "episode"} <= counted_nouns()
    translated(PseudoTranslator())
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
    assert count_noun(3, "probe") == "3 pr\u00f6b\u00ebs \u00fcn"


def test_fields_and_counts_read_well_in_english():
    assert tr("{} of {:.1f} placed", 1, 2) == "1 of 2.0 placed"
    assert [count_noun(n, "probe") for n in (0, 1, 1200)] == ["0 probes", "1 probe", "1,200 probes"]


def test_the_check_of_the_texts_finds_english_and_lets_data_pass():
    assert plain_words("Gr\u00efp the piece") == ("the piece",)
    assert plain_words("pl\u00e5\u00e7\u00ebd 3 mm, N\u00b7m 0.2, lab.toml, Ctrl+Q") == ()
    assert plain_words("\u00e5t: Force trip: 41.3 N over 40 N.") == ()
    assert plain_words("Not of the backend: a sentence") != ()


SCORE = Score((Outcome.PLACED, Outcome.FELL, Outcome.ABORTED), 5, (0.2, 0.9), "", 0)
WHERE = OffsetScene(
    bottom=np.array([[0.0, 0.0], [20.0, 0.0], [0.0, 20.0]]), face=np.eye(2), offset_mm=(1.0, 2.0),
    margin_mm=-1.0, support=SupportKind.AREA,
)  # fmt: skip


def representative_views(theme):
    """Return panels and pages with composed, painted and listed texts."""
    stack, train, score = StackPage(theme), TrainPage(theme), ScorePanel(theme)
    stack.show_waiting("Connecting", "The bench is being prepared.")
    list(train.build())
    score.show_score(SCORE)
    chip, probe, table = DeviceChip(theme, "Arm"), LastProbePanel(print), EpisodeTable(theme, print)
    chip.show_value(ChipValue("stale", tr("stale {:.1f} s", 2.0), 12))
    probe.show_words(ProbeText("Probing", detail=tr("The first probe is on its way.")))
    table.show_rows([EpisodeTableRow("1", "1", "approved", "ok", "+1.0, +2.0", "12:00")], "")
    card = FaultCard(stopped_card(print), print, print)
    face = OffsetView(theme, print, print)
    face.show_scene(WHERE)
    return [stack, train, score, chip, probe, table, card, face]


def test_representative_views_show_no_english_in_the_pseudo_locale(qtbot, translated):
    translated(PseudoTranslator())
    theme = Theme()
    views = representative_views(theme)
    for view in views:
        qtbot.addWidget(view)
    for view in views:
        view.resize(900, 700)
        view.show()
        assert untranslated(type(view).__name__) == {}
        view.close()


def test_the_check_of_the_texts_reads_every_kind_of_widget(qtbot):
    view = QWidget()
    qtbot.addWidget(view)
    combo, table = QComboBox(view), FigureTable(Theme(), "Names", ("head", "second one"))
    table.setParent(view)
    combo.addItem("an entry")
    combo.setToolTip("its tip")
    combo.setAccessibleName("its name")
    table.show_rows([("a cell", "")])
    Painted(view).setGeometry(0, 0, 50, 50)
    view.setWindowTitle("the title")
    view.show()
    found = {text for text in untranslated("state") if not text[0].isdigit()}
    assert found >= {"an entry", "its tip", "its name", "a cell", "head", "the title"}


GERMAN = {
    "{} of {} placed": "von {1} gestellt: {0}", "%n probe": "%n Probe", "%n probes": "%n Proben",
    "Seed {}: {} after {}.": "Startwert {0}: nach {2} {1}.", "placed": "gestellt",
}  # fmt: skip


def test_a_translation_changes_order_and_plural_of_composed_texts(qtbot, translated, tmp_path):
    """As by ``make texts`` and Qt Linguist, from the sources to the shown text."""
    source = tmp_path / "touchdown_de.ts"
    write_texts(source)
    tree = ElementTree.parse(source)
    for message in tree.iter("message"):
        said = message.find("translation")
        forms = said.findall("numerusform")
        source_text = message.findtext("source")
        if forms and source_text in GERMAN:
            forms[0].text, forms[1].text = GERMAN[source_text[:-1]], GERMAN[source_text]
        elif source_text in GERMAN:
            said.text = GERMAN[source_text]
        else:
            continue
        said.attrib.clear()
    tree.write(source, encoding="utf-8")
    tool = Path(sys.executable).with_name("pyside6-lrelease")
    subprocess.run([str(tool), str(source)], check=True, capture_output=True)
    translator = QTranslator()
    assert translator.load("touchdown_de", str(tmp_path))
    translated(translator)
    panel = ScorePanel(Theme())
    qtbot.addWidget(panel)
    panel.show_score(SCORE)
    assert panel.words.startswith("von 3 gestellt: 1")
    assert [count_noun(n, "probe") for n in (1, 2)] == ["1 Probe", "2 Proben"]
    seed = tr("Seed {}: {} after {}.", 7, tr("placed"), count_noun(3, "probe"))
    assert seed == "Startwert 7: nach 3 Proben gestellt."
    assert tr("No trial yet") == "No trial yet"


def test_the_pixels_of_a_picture_outlive_its_image(qtbot):
    shown = QLabel("Placed")
    qtbot.addWidget(shown)
    kept = [pictures.pixels_of(shown) for _ in range(20)]
    assert all(one.flags.owndata for one in kept)
    assert all(np.array_equal(one, kept[0]) for one in kept)
