"""A report of experiments in Review: as the page shows it, and nothing of it blocks the window."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QApplication, QFileDialog, QWidget

from tests.app.conftest import opened
from touchdown.app.review import reports
from touchdown.app.review.reports import recolour_drawing, render_drawing
from touchdown.backend.experiments.document import (
    INK,
    PictureGallery,
    Report,
    ReportPicture,
    ReportSection,
    ReportTable,
    reliability_chart,
    report_page,
)
from touchdown.backend.experiments.results import read_report
from touchdown.widgets.base.theme import DARK, LIGHT, Theme, load_resources
from touchdown.widgets.views.report import PictureCard, ReportGrid, ReportSheet

FULL = Path(__file__).parents[2] / "docs/results/tables-full.json"


@pytest.fixture
def review(qapp, qtbot, tmp_path):
    with opened(tmp_path) as main:
        main.window.show()
        main.go("review")
        workspace = main.workspaces["review"]
        qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
        yield workspace


def open_report(review, qtbot, file):
    review.reports.open(file)
    qtbot.waitUntil(lambda: not review.reader.busy, timeout=60_000)


def grids(sheet):
    return sheet.room.widget().findChildren(ReportGrid)


def test_the_window_shows_what_the_report_says(review, qtbot, tmp_path):
    file = tmp_path / "tables.json"
    file.write_bytes(FULL.read_bytes())
    _, report = read_report(file)
    open_report(review, qtbot, file)
    sheet = review.reports.sheet
    assert sheet.isVisible()
    assert not sheet.isModal()
    assert [sheet.parts.item(k).text() for k in range(sheet.parts.count())] == [
        section.title for section in report.sections
    ]
    wanted = report.sections[0].parts[0]
    grid = grids(sheet)[0]
    for row, (name, entries) in enumerate(wanted.rows):
        assert grid.verticalHeaderItem(row).text() == name
        for column, entry in enumerate(entries):
            shown = grid.item(row, column).data(Qt.ItemDataRole.UserRole)
            lines = (entry.interval, *entry.notes) if entry.interval else entry.notes
            assert (shown.value, shown.lines) == (entry.value, lines)


def test_in_text_of_twice_the_size_the_report_fits_into_the_least_window(qapp, qtbot):
    load_resources()
    theme, window = Theme(), QWidget()
    qtbot.addWidget(window)
    window.resize(1280, 720)
    try:
        theme.apply(qapp, "dark", 2.0)
        sheet = ReportSheet(window)
        sheet.show_head(
            "Touchdown: the paper's experiments, full",
            "SIMULATED BENCH: no robot moved for these figures",
            str(FULL),
            ["Table 1: contact patch from one probe"],
        )
        sheet.open_large()
        QApplication.processEvents()
        assert (sheet.width(), sheet.height()) == (1220, 660)
    finally:
        theme.apply(qapp, "dark", 1.0)


def test_a_cell_names_its_job_and_a_missing_page_is_written(review, qtbot, tmp_path, monkeypatch):
    file = tmp_path / "tables.json"
    file.write_bytes(FULL.read_bytes())
    opened = []
    monkeypatch.setattr(reports, "open_in_viewer", lambda path: opened.append(path) or "Opened")
    open_report(review, qtbot, file)
    sheet, first = review.reports.sheet, review.reports.report.sections[0].parts[0].rows[0][1][0]
    assert first.jobs[0] in grids(sheet)[0].item(0, 0).toolTip()
    sheet.browser.click()
    qtbot.waitUntil(lambda: len(opened) == 1, timeout=60_000)
    page = review.exports / "tables.html"
    assert opened == [page]
    assert page.read_text("utf-8") == FULL.with_suffix(".html").read_text("utf-8")


def test_pictures_come_after_the_part_and_not_into_another(review, qtbot):
    open_report(review, qtbot, FULL)
    sheet = review.reports.sheet
    titles = [section.title for section in review.reports.report.sections]
    sheet.parts.setCurrentRow(titles.index("Belief maps by probe"))
    sheet.parts.setCurrentRow(titles.index("Calibration of the probabilities"))
    qtbot.waitUntil(lambda: not review.reader.busy, timeout=60_000)
    cards = sheet.room.widget().findChildren(PictureCard)
    assert len(cards) == 6
    assert all(not card.picture.pixmap().isNull() for card in cards)


@pytest.mark.parametrize("content", ["{", '{"format": "touchdown-tables/1", "table1": 5}'])
def test_a_bad_file_is_one_card_and_no_sheet(review, qtbot, tmp_path, content):
    file = tmp_path / "tables.json"
    file.write_text(content, encoding="utf-8")
    before = set(review._context.cards.codes)
    open_report(review, qtbot, file)
    assert set(review._context.cards.codes) - before == {"REPORT"}
    assert review.reports.sheet is None


def test_reports_are_listed_and_another_file_is_asked_for_beside_the_window(
    review, qtbot, tmp_path
):
    file = tmp_path / "mine" / "tables.json"
    file.parent.mkdir()
    file.write_bytes(FULL.read_bytes())
    open_report(review, qtbot, file)
    review.reports.sheet.close()
    review.page.experiments.click()
    menu = review.reports.menu
    names = [action.text() for action in menu.actions()]
    assert (names[0], names[-1]) == ("mine/tables.json", "Other file\N{HORIZONTAL ELLIPSIS}")
    assert "results/tables-full.json" in names
    menu.actions()[names.index("results/tables-full.json")].trigger()
    qtbot.waitUntil(lambda: review.reports.sheet.isVisible() and not review.reader.busy)
    assert review.reports._file == FULL.resolve()
    review.page.experiments.click()
    review.reports.menu.actions()[-1].trigger()
    review.reports.menu.close()
    (dialog,) = review.page.findChildren(QFileDialog)
    assert dialog.isVisible()
    dialog.reject()


def test_identifications_of_the_data_folder_are_listed_and_shown(
    review, qtbot, tmp_path, monkeypatch
):
    monkeypatch.setenv("TOUCHDOWN_DATA", str(tmp_path))
    picture = ReportPicture(reliability_chart([0.1, 0.9], [0.2, 0.8], "Gel", "n = 3"))
    made = Report("Identified bench", ("Better.",), (
        ReportSection("1. Sensors at rest", ("Identified: 2.",), (
            ReportTable.of_texts("", ("parameter", "value"), [("noise", "0.1")]),
            PictureGallery("", (picture,)),
        )),
    ))  # fmt: skip
    file = tmp_path / "identified" / "LAB" / "bench.json"
    file.parent.mkdir(parents=True)
    content = {"format": "touchdown-identification/1", "report": asdict(made)}
    file.write_text(json.dumps(content), "utf-8")
    file.with_suffix(".html").write_text(report_page(made), "utf-8")
    stage = file.parent / "bench.stages" / "fit.json"
    stage.parent.mkdir()
    stage.write_text("{}", "utf-8")
    review.page.experiments.click()
    listed = {action.text(): action for action in review.reports.menu.actions()}
    assert "LAB/bench.json" in listed
    assert "bench.stages/fit.json" not in listed
    listed["LAB/bench.json"].trigger()
    qtbot.waitUntil(lambda: not review.reader.busy, timeout=60_000)
    assert review.reports.report == made
    assert review.reports.sheet.parts.item(0).text() == "1. Sensors at rest"
    cards = review.reports.sheet.room.widget().findChildren(PictureCard)
    assert [card.picture.pixmap().isNull() for card in cards] == [False]
    seen = []
    monkeypatch.setattr(reports, "open_in_viewer", lambda path: seen.append(path) or "Opened")
    review.reports.sheet.browser.click()
    qtbot.waitUntil(lambda: len(seen) == 1, timeout=60_000)
    assert seen == [file.with_suffix(".html")]


def test_charts_take_the_colours_of_the_theme():
    chart = reliability_chart([0.1, 0.9], [0.2, 0.8], "Pot", "n = 3")
    assert INK not in recolour_drawing(chart, DARK)
    dark, light = (render_drawing(chart, 2.0, tokens) for tokens in (DARK, LIGHT))
    assert dark.size().toTuple() == (440, 440)
    inked = {image.pixelColor(x, y).lightness() for image in (dark,) for x in range(440)
             for y in range(20, 40) if image.pixelColor(x, y).alpha() > 200}  # fmt: skip
    assert max(inked) > 200
    assert dark != light
