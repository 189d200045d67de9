"""Sheet that identifies a bench from the recordings of a dataset."""

from __future__ import annotations

import json
import re
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from PySide6.QtCore import QProcess, Qt, QUrl, Signal
from PySide6.QtGui import QDesktopServices
from PySide6.QtWidgets import QApplication, QLineEdit, QProgressBar, QWidget

from touchdown.app.shell import BenchSheet, ask_path
from touchdown.backend.core import data_folder, write_atomically
from touchdown.backend.runs import dataset_folder
from touchdown.widgets.base import Theme, hbox, label, push_button, set_property, tr
from touchdown.widgets.lists import FigureTable

PROGRESS = re.compile(r"(.+): ([\d,]+) of ([\d,]+)(.*)")
TITLE = "Fit the simulated bench to this robot (Identify)"
COLUMNS = ("parameter", "value", "standard uncertainty", "goes into the file")
ABOUT = (
    "Finds the values with which the simulated bench predicts recorded presses best. Nothing moves "
    "here. Collect records the presses: choose the three recordings for Identify as its pattern, "
    "one after the other. Write bench file offers to restart with the result."
)
CANCELLED = "Cancelled. Identify again to continue from the finished stages."
END_MS = 2000


class IdentifySheet(BenchSheet):
    """Dataset, progress, verdict and parameters. The fit runs in a process of its own.

    ``written`` gets the bench file that is kept.
    """

    written = Signal(object)

    def __init__(self, parent: QWidget, theme: Theme) -> None:
        super().__init__(parent, TITLE)
        self.dataset = QLineEdit(str(dataset_folder()))
        self.dataset.setAccessibleName(tr("Dataset"))
        self.choose = push_button("Choose\N{HORIZONTAL ELLIPSIS}")
        self.begin, self.cancel = push_button("Identify"), push_button("Cancel")
        tip = "Keep the bench file in the data folder, named by the time"
        self.accept_it, self.report = push_button("Write bench file", tip), push_button("Report")
        self.progress = QProgressBar()
        self.verdict, self.note = label("", "title", wrap=True), label("", wrap=True)
        self.table = FigureTable(theme, "Parameters", COLUMNS)
        self.table.empty = "No result yet"
        self._child, self._error, self._draft, self._page = QProcess(self), "", Path(), ""
        self._child.readyReadStandardError.connect(self._read)
        self._child.finished.connect(self._finished)
        take = self.dataset.setText
        self.choose.clicked.connect(lambda: ask_path(self, "Dataset", lambda at: take(str(at))))
        self.begin.clicked.connect(self._start)
        self.cancel.clicked.connect(self.end)
        self.accept_it.clicked.connect(self._accept)
        self.report.setEnabled(False)
        open_page = QDesktopServices.openUrl
        self.report.clicked.connect(lambda: open_page(QUrl.fromLocalFile(self._page)))
        application = QApplication.instance()
        assert application is not None
        application.aboutToQuit.connect(self.end)
        row = hbox(label("Dataset"), (self.dataset, 1), self.choose)
        texts = (self.verdict, self.note, (self.table, 1))
        foot = (self.begin, self.cancel, self.accept_it, self.report)
        self.about = label(ABOUT, "muted", wrap=True)
        about = label(TITLE, "head"), self.about
        self.arrange(*about, row, self.progress, *texts, foot=foot, spacing=10)
        self.note.hide()
        self.resize_to_em(44, 34)
        self._show_buttons(can_accept=False)

    def end(self) -> None:
        """End the process. Its stages are written atomically, so that finished ones are kept."""
        if self._is_running():
            self._child.kill()
            self._child.waitForFinished(END_MS)

    def show_line(self, line: str) -> None:
        """Show a line of progress; keep an error for the end."""
        if found := PROGRESS.fullmatch(line):
            stage, done, total, left = found.groups()
            self.progress.show()
            self.progress.setRange(0, int(total.replace(",", "")))
            self.progress.setValue(int(done.replace(",", "")))
            self.progress.setFormat(f"{stage}: %p %{left}")
        elif line.startswith("{"):
            error = json.loads(line)["error"]
            self._error = f"{error['what']} {error['fix']}"
        elif line:
            self._error = line

    def show_end(self, code: int, output: str) -> None:
        """Show the result ``output`` of the process, a JSON object, or its error."""
        self.progress.reset()
        found: dict[str, Any] = json.loads(output) if code in (0, 1) and output else {}
        self.verdict.setText(found.get("reason") or self._error or tr(CANCELLED))
        tone = "good" if found.get("accepted") else "bad" if found or self._error else ""
        set_property(self.verdict, "tone", tone)
        self.table.show_rows([
            (tr(found["names"][key]), f"{_rounded(value, 4)} {unit}".removesuffix(" 1"),
             _rounded(sigma, 2), tr(found["use"][key]))
            for key, (value, sigma, unit) in found.get("estimates", {}).items()
        ])  # fmt: skip
        cells, tip = self.table.model(), Qt.ItemDataRole.ToolTipRole
        for row, key in enumerate(found.get("estimates", ())):
            cells.setData(cells.index(row, 0), key, tip)
        self._page = found.get("report", "")
        self.report.setEnabled(bool(found))
        self._show_note("\n".join(found.get("verdicts", ())))
        self._show_buttons(can_accept=bool(found.get("accepted")))

    def _start(self) -> None:
        dataset = Path(self.dataset.text())
        self._draft, self._error = data_folder() / "identified" / dataset.name / "bench.toml", ""
        words = ("-m", "touchdown", "identify", str(dataset), "--out", str(self._draft), "--json")
        self.verdict.setText("")
        self._show_note("")
        self._child.start(sys.executable, words)
        self.progress.setRange(0, 0)
        self._show_buttons(can_accept=False)

    def _accept(self) -> None:
        kept = data_folder() / "benches" / f"{datetime.now():%Y%m%d-%H%M%S}.toml"
        try:
            write_atomically(kept, self._draft.read_bytes())
        except OSError as error:
            self._show_note(tr("The bench file cannot be kept: {}", error))
            return
        self._show_note(tr("Written: {}. Bench in the rail opens it.", kept))
        self.accept_it.setEnabled(False)
        self.written.emit(kept)

    def _finished(self, code: int) -> None:
        self._read()
        self.show_end(code, bytes(self._child.readAllStandardOutput().data()).decode())

    def _is_running(self) -> bool:
        return self._child.state() != QProcess.ProcessState.NotRunning

    def _read(self) -> None:
        for line in bytes(self._child.readAllStandardError().data()).decode().splitlines():
            self.show_line(line)

    def _show_note(self, text: str) -> None:
        """Show ``text`` below the verdict, in place of the explanation."""
        self.note.setText(text)
        self.note.setVisible(bool(text))
        self.about.setVisible(not text)

    def _show_buttons(self, *, can_accept: bool) -> None:
        running = self._is_running()
        self.cancel.setEnabled(running)
        self.progress.setVisible(running)
        for widget in (self.dataset, self.choose, self.begin):
            widget.setEnabled(not running)
        self.accept_it.setEnabled(can_accept)
        set_property(self.accept_it, "role", "primary" if can_accept else "")
        set_property(self.begin, "role", "" if can_accept else "primary")


def _rounded(value: float, digits: int) -> str:
    """Return ``value`` with this many significant digits, without an exponent."""
    return np.format_float_positional(
        value, precision=digits, unique=False, fractional=False, trim="-"
    )
