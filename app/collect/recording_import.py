"""Sheet that imports recordings of other laboratories, by a mapping of their signals."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QCheckBox, QGridLayout, QPlainTextEdit, QProgressBar, QWidget

from touchdown.app.shell import BenchSheet, FileDrop, SaveWorker, ask_path
from touchdown.backend import exchange
from touchdown.backend.annotations import Dataset
from touchdown.backend.core import InputError, data_folder, read_limited, write_atomically
from touchdown.widgets import base
from touchdown.widgets.lists import FigureTable
from touchdown.widgets.plots import CurveLine, SignalPlot

COLUMNS = ("source", "type", "numbers", "per s")
PLOTS = ("Force", "Moment", "Hand from contact", "Markers, left", "Markers, right")
# Row, column and width of the findings of a signal, below its plots.
SIGNALS = {"wrench": (1, 0, 2), "pose": (1, 2, 1), "left": (3, 0, 1), "right": (3, 1, 1)}
COLOURS = {"x": "axis_x", "y": "axis_y", "z": "axis_z", "u": "axis_x", "v": "axis_y"}
MOST_POINTS = 400  # of a curve
NO_FILE = "Choose a recording (MCAP of ROS 2, or the folder of a LeRobot dataset), or drop one."
NO_DATASET = "Give your name in Collect (Ctrl+U): this opens the dataset that takes the presses."
HINT = "In contact Fz rises, z of the hand falls, and v of the markers falls, towards the hand."
ImportTarget = tuple[Dataset | None, str, str, str]  # dataset, person, piece, bottom


class RecordingSheet(BenchSheet):
    """Recording, mapping, and preview of its first press; the presses go into the open dataset.

    Files are read in a process of their own, which *Cancel* and closing the sheet end. ``imported``
    gets the name of the recording and the ids of the new episodes. ``target`` returns the dataset
    and the pair of the form.
    """

    imported = Signal(str, list)

    def __init__(
        self, parent: QWidget, theme: base.Theme, target: Callable[[], ImportTarget]
    ) -> None:
        super().__init__(parent, "Import recordings")
        self._target, self._source = target, Path()
        self._worker, self._cancelled = SaveWorker(self, "recording-import"), Event()
        self._busy = self._writing = False
        self._found: tuple[exchange.EpisodeImport, exchange.ImportSurvey] | None = None
        self.choose = base.push_button("Choose a file\N{HORIZONTAL ELLIPSIS}")
        self.choose_folder = base.push_button("Choose a folder\N{HORIZONTAL ELLIPSIS}")
        self.preview, self.cancel, self.add = map(base.push_button, ("Preview", "Cancel", "Import"))
        tip = "Set the values to try, and look at the preview again"
        self.correct = base.push_button("Apply the corrections", tip)
        self.file, self.note = base.label(NO_FILE, wrap=True), base.label("", wrap=True)
        self.contents = FigureTable(theme, "Signals of the recording", COLUMNS)
        self.contents.empty, self.contents.elided = "No recording yet", True
        self.mapping = QPlainTextEdit()
        self.mapping.setAccessibleName(base.tr("Mapping"))
        self.plots = {title: SignalPlot(theme, title) for title in PLOTS}
        self.findings = {name: base.label("", "small", wrap=True) for name in SIGNALS}
        self.progress = QProgressBar()
        self.anyway = QCheckBox(base.tr("Import in spite of contradictions"))
        names = "MCAP, TOML (*.mcap *.toml)"
        self.choose.clicked.connect(lambda: ask_path(self, "Recording", self.take, names=names))
        self.choose_folder.clicked.connect(lambda: ask_path(self, "Recording", self.take))
        self.mapping.textChanged.connect(self._forget)
        self.preview.clicked.connect(self.read)
        self.correct.clicked.connect(self._correct)
        self.cancel.clicked.connect(lambda: self._cancelled.set())
        self.finished.connect(lambda _: self._cancelled.set())
        self.anyway.toggled.connect(self._show_buttons)
        self.add.clicked.connect(self.write)
        FileDrop(self, (".mcap", ".toml", ""), self.take)
        self._arrange()

    def take(self, path: Path) -> None:
        """List the signals of a recording and propose a mapping, or read a mapping file."""
        self.present()
        if self._busy:
            return
        if path.suffix == ".toml":
            # A file of another kind is shown, and refused by the preview in words.
            def text(_: Event) -> str:
                content = read_limited(path, 1_000_000, "Name a TOML file below 1 MB.")
                return content.decode("utf-8", "replace")

            self._run("Reading", text, self.mapping.setPlainText)
        else:
            self._source = path
            self.file.setText(path.name)
            self._forget()
            self._run("Reading", partial(exchange.recording_contents, path), self._list)

    def read(self) -> None:
        """Read the recording by the mapping; show its first press and what contradicts it."""
        dataset, person, piece, bottom = self._target()
        if dataset is None or not dataset.writable:
            self._say(NO_DATASET, bad=True)
            return
        source, text = self._source, self.mapping.toPlainText()
        kept = data_folder() / "mappings" / f"{source.stem}.toml"

        def read(cancelled: Event) -> tuple[exchange.EpisodeImport, exchange.ImportSurvey]:
            write_atomically(kept, text.encode("utf-8"))
            options = exchange.ImportOptions(person, None, piece, bottom, kept, cancelled)
            form = exchange.recording_format(source)
            wanted = exchange.EpisodeImport(dataset, form, source, options)
            return wanted, wanted.survey()

        stored = base.tr("The presses are stored as {} on {}.", piece, bottom)
        self._run("Reading; pictures are tracked", read, partial(self._show, stored))

    def write(self) -> None:
        """Add the presses to the dataset."""
        if self._found is not None:
            wanted, survey = self._found
            advance, put = self.progress.setValue, self._worker.put
            self._writing = True
            self._run(
                "Writing",
                lambda _: wanted.write(lambda done: put(partial(advance, done))),
                self._written,
            )
            self.progress.setRange(0, survey.fit)

    def close_worker(self) -> None:
        """End reading and thread."""
        self._cancelled.set()
        self._worker.close()

    # -- inside -----------------------------------------------------------------------------------

    def _arrange(self) -> None:
        left = base.vbox(
            base.label("Import recordings", "head"), base.hbox(self.choose, self.choose_folder, 1),
            self.file, (self.contents, 3),
            base.label("Mapping", "title"), (self.mapping, 4),
        )  # fmt: skip
        grid = QGridLayout()
        for at, plot in enumerate(self.plots.values()):
            grid.addWidget(plot, at // 3 * 2, at % 3)
            grid.setRowStretch(at // 3 * 2, 1)
            grid.setColumnStretch(at % 3, 1)
        for name, (row, column, span) in SIGNALS.items():
            grid.addWidget(self.findings[name], row, column, 1, span, Qt.AlignmentFlag.AlignTop)
        grid.addWidget(base.label(HINT, "small", wrap=True), 2, 2)
        right = base.vbox((grid, 1), self.anyway, self.note, self.progress)
        foot = self.preview, self.correct, self.cancel, self.add
        self.arrange(base.hbox((left, 3), (right, 5), spacing=14), foot=foot, spacing=10)
        self.resize_to_em(76, 46)
        self._show_buttons()

    def _run(self, words: str, work: Callable[[Event], Any], done: Callable[[Any], None]) -> None:
        """Run ``work`` on the thread, one at a time."""
        self._busy, self._cancelled = True, Event()

        def end(show: Callable[[Any], None], result: Any) -> None:
            self._busy = self._writing = False
            self._say("")
            show(result)
            self._show_buttons()

        self._say(f"{base.tr(words)} \N{HORIZONTAL ELLIPSIS}")
        self.progress.setRange(0, 0)
        job = partial(work, self._cancelled)
        self._worker.submit(job, partial(end, done), partial(end, self._failed))
        self._show_buttons()

    def _list(self, contents: list[exchange.RecordedSignal]) -> None:
        self.contents.show_rows([
            (one.name, one.kind.rpartition("/")[2], f"{one.numbers or ''}", f"{one.rate_hz:.1f}")
            for one in contents
        ])  # fmt: skip
        self.mapping.setPlainText(exchange.propose_mapping(contents))
        self._say("Correct the mapping, or drop one, then look at the preview.")

    def _show(
        self, stored: str, found: tuple[exchange.EpisodeImport, exchange.ImportSurvey]
    ) -> None:
        self._found, (wanted, survey) = found, found
        press = wanted.presses[0].recording if wanted.presses else None
        for plot in self.plots.values():
            plot.show_lines((), 0)
        for title, unit, axes, t_s, rows in exchange.press_curves(press) if press else ():
            thin, plot = slice(None, None, 1 + len(t_s) // MOST_POINTS), self.plots[title]
            points = [tuple(zip(t_s[thin].tolist(), row, strict=True)) for row in rows[thin].T]
            plot.name = f"{base.tr(title)} ({unit})"
            plot.show_lines([CurveLine(axis, own, COLOURS[axis])
                             for axis, own in zip(axes, points, strict=True)], 0)  # fmt: skip
        for name, said in self.findings.items():
            against = [one for one in survey.contradictions if f"'{name}'" in one]
            said.setText(" ".join(against) or base.tr("Nothing contradicts '{}'.", name))
            base.set_property(said, "tone", "bad" if against else "good")
        numbers = base.count_noun(survey.found, "episode"), survey.here, survey.fit
        words = [base.tr("{} found, {} present already, {} can be imported.", *numbers)]
        words += [base.tr("{} cannot be mapped: {}.", count, why) for why, count in survey.problems]
        self._say(" ".join([*words, stored, *survey.losses]))

    def _correct(self) -> None:
        if self._found is not None:
            text = exchange.correct_mapping(self.mapping.toPlainText(), self._found[1].proposed)
            # An edit that Ctrl+Z takes back.
            self.mapping.selectAll()
            self.mapping.insertPlainText(text)
            self.read()

    def _written(self, uuids: list[str]) -> None:
        self._found = None
        self.imported.emit(self._source.name, uuids)
        self.close()

    def _failed(self, error: Exception) -> None:
        words = f"{error.what} {error.fix}" if isinstance(error, InputError) else str(error)
        if isinstance(error, OSError):
            words = base.tr("A file cannot be read or written: {}.", error.strerror or error)
        self._say(words, bad=True)

    def _forget(self) -> None:
        self._found = None
        self._show_buttons()

    def _say(self, words: str, *, bad: bool = False) -> None:
        self.note.setText(base.tr(words))
        base.set_property(self.note, "tone", "bad" if bad else "")

    def _show_buttons(self) -> None:
        contradicted = self._found is not None and bool(self._found[1].contradictions)
        can_add = self._found is not None and self._found[1].fit > 0 and not self._busy
        can_add = can_add and (not contradicted or self.anyway.isChecked())
        self.anyway.setVisible(contradicted)
        self.progress.setVisible(self._busy)
        self.cancel.setEnabled(self._busy and not self._writing)
        self.preview.setEnabled(not self._busy and self._source.name != "")
        for button in (self.choose, self.choose_folder, self.mapping):
            button.setEnabled(not self._busy)
        self.add.setEnabled(can_add)
        base.set_property(self.add, "role", "primary" if can_add else "")
        proposed = self._found is not None and bool(self._found[1].proposed) and not self._busy
        self.correct.setEnabled(proposed)
        base.set_property(self.correct, "role", "primary" if proposed and not can_add else "")
        first = self.preview if self._source.name else self.choose
        for button in (self.choose, self.preview):
            is_next = button is first and not can_add and not proposed
            base.set_property(button, "role", "primary" if is_next else "")
