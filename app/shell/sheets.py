"""Dialogs of the bench: their frame and their questions."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

from PySide6.QtCore import QEvent, QObject, QSize, Qt
from PySide6.QtGui import QDragEnterEvent, QDropEvent
from PySide6.QtWidgets import (
    QDialog,
    QFileDialog,
    QFrame,
    QLayout,
    QPushButton,
    QScrollArea,
    QWidget,
)

from touchdown.backend.core import InputError
from touchdown.backend.runs import Bookmark, keep_bookmark
from touchdown.widgets.base import ElidedLabel, FlowLayout, hbox, label, rule, scroll_area, tr, vbox
from touchdown.widgets.forms import NameDialog

LEAST_WINDOW = QSize(400, 330)  # of the main window: 800 px wide at scale 2
TOP_BAR_PX = 64  # with STOP


class QuestionRow(QFrame):
    """A question with two answers; no does nothing. ``low``: one line in the foot of the window."""

    def __init__(self, *, low: bool = False) -> None:
        super().__init__()
        self.setProperty("role", "question")
        self.text = ElidedLabel("title") if low else label("", "title", wrap=True)
        self.no, self.yes = QPushButton(tr("No")), QPushButton(tr("Yes"))
        self._act: Callable[[], None] | None = None
        for button in (self.no, self.yes):
            button.setAutoDefault(False)
            button.setProperty("low", "yes" if low else "")
        hbox((self.text, 1), self.no, self.yes, parent=self, margins=(8, 0, 0, 0) if low else None)
        if low:
            policy = self.text.sizePolicy()
            policy.setHorizontalPolicy(policy.Policy.Maximum)
            self.text.setSizePolicy(policy)
        self.no.clicked.connect(self.withdraw)
        self.yes.clicked.connect(self._accept)
        self.hide()

    def ask(self, text: str, no: str, yes: str, act: Callable[[], None]) -> None:
        """Ask a question; ``act`` is called for yes. No text withdraws the question of ``act``."""
        if not text and act is not self._act:
            return
        self._act = act
        self.text.setText(tr(text))
        for button, word in ((self.no, no), (self.yes, yes)):
            button.setText(tr(word))
            button.setAccessibleName(f"{tr(word)}: {tr(text)}")
        self.setVisible(bool(text))

    def withdraw(self) -> None:
        """Remove the question."""
        self._act = None
        self.hide()

    def _accept(self) -> None:
        act = self._act
        self.withdraw()
        if act is not None:
            act()


class BenchSheet(QDialog):
    """Dialog with buttons and *Close* at its foot. Not modal: STOP and all pages stay available."""

    def __init__(self, parent: QWidget, title: str) -> None:
        super().__init__(parent)
        self.setWindowTitle(tr(title))

    def give_width(self, em: float) -> None:
        """Set the least width in heights of the font; not wider than the main window."""
        window = self.parentWidget()
        assert window is not None
        room = max(window.width(), LEAST_WINDOW.width())
        self.setMinimumWidth(min(round(em * self.fontMetrics().height()), room))

    def present(self) -> None:
        """Show the sheet above the window."""
        self.show()
        self.raise_()

    def arrange(
        self, *parts: QWidget | QLayout | tuple[QWidget | QLayout, int] | int,
        foot: tuple[QPushButton, ...], spacing: int,
    ) -> None:  # fmt: skip
        """Fill the sheet with ``parts`` (as in ``vbox``) above a row of buttons."""
        close = QPushButton(tr("Close"))
        close.clicked.connect(self.close)
        for button in (*foot, close):
            button.setAutoDefault(False)
        row, body = FlowLayout(*foot, (QWidget(), 1), close), QWidget()
        vbox(*parts, parent=body, margins=(0, 0, 8, 0), spacing=spacing)
        scroll = scroll_area(body)
        scroll.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        scroll.setSizeAdjustPolicy(QScrollArea.SizeAdjustPolicy.AdjustToContents)
        vbox((scroll, 1), rule(), row, parent=self, margins=(18, 14, 18, 14), spacing=spacing)

    def resize_to_em(self, width: int, height: int) -> None:
        """Set the size in heights of the font; in the middle of the window it leaves STOP free."""
        em, parent = self.fontMetrics().height(), self.parentWidget()
        assert parent is not None
        room = (parent.size() - QSize(0, 2 * TOP_BAR_PX)).expandedTo(LEAST_WINDOW)
        self.resize(QSize(width * em, height * em).boundedTo(room))


class BookmarkDialog(NameDialog):
    """Asks for the note of a bookmark, and stores it beside the recording."""

    def ask_note(self, path: Path, mark: Bookmark, done: Callable[[list[Bookmark]], None]) -> None:
        """Ask for the note of ``mark`` in the file ``path``; ``done`` gets all bookmarks."""

        def take(text: str) -> str:
            note = " ".join(text.split())
            if not note and not mark.note:
                return tr("Type a note.")
            try:
                done(keep_bookmark(path, replace(mark, note=note)))
            except InputError as error:
                return f"{error.what} {error.fix}"
            return ""

        what = "Note at {:.2f} s (an empty note removes it)" if mark.note else "Note at {:.2f} s"
        self.ask(tr(what, mark.t_s), (), take, mark.note)


class FileDrop(QObject):
    """Accepts one dropped file with one of ``suffixes`` ("": a folder); ``take`` gets its path."""

    def __init__(
        self, widget: QWidget, suffixes: Collection[str], take: Callable[[Path], None]
    ) -> None:
        super().__init__(widget)
        self._suffixes, self._take = suffixes, take
        widget.setAcceptDrops(True)
        widget.installEventFilter(self)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Accept a drag of one such file, and take it when it is dropped."""
        if isinstance(event, QDragEnterEvent | QDropEvent):
            paths = [Path(url.toLocalFile()) for url in event.mimeData().urls()]
            suffixes = ["" if path.is_dir() else path.suffix.lower() or None for path in paths]
            if len(paths) == 1 and suffixes[0] in self._suffixes:
                event.acceptProposedAction()
                if event.type() is QEvent.Type.Drop:
                    self._take(paths[0])
                return True
        return super().eventFilter(watched, event)


def ask_path(
    parent: QWidget, title: str, take: Callable[[Path], None], *, start: Path | None = None,
    names: str = "",
) -> None:  # fmt: skip
    """Let the user choose a file that fits the filter ``names``, or a folder without a filter.

    The window is not blocked.
    """
    dialog = QFileDialog(parent, tr(title), str(start or ""), names)
    mode = QFileDialog.FileMode.ExistingFile if names else QFileDialog.FileMode.Directory
    dialog.setFileMode(mode)
    dialog.setOption(QFileDialog.Option.DontUseNativeDialog)
    dialog.fileSelected.connect(lambda name: take(Path(name)))
    dialog.finished.connect(dialog.deleteLater)
    dialog.open()
