"""Two halves of one workspace, collecting and labelling, and the switch between them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from PySide6.QtWidgets import (
    QButtonGroup,
    QHBoxLayout,
    QPushButton,
    QStackedWidget,
    QVBoxLayout,
    QWidget,
)


class Halves(QWidget):
    """Shows one half at a time; the switch is there as soon as there are two."""

    def __init__(self) -> None:
        super().__init__()
        self.setObjectName("frame")
        self._stack, self._buttons = QStackedWidget(), QButtonGroup(self)
        self._names: list[str] = []
        self._halves: list[QWidget] = []
        self._entered: Callable[[str], None] = _nothing
        self._bar = QWidget()
        self._row = QHBoxLayout(self._bar)
        self._row.setContentsMargins(10, 8, 10, 0)
        self._row.setSpacing(4)
        self._row.addStretch(1)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(0)
        column.addWidget(self._bar)
        column.addWidget(self._stack, 1)
        self._bar.hide()
        self._buttons.idClicked.connect(lambda at: self.show_half(self._names[at]))

    def heightForWidth(self, _width: int) -> int:
        """Ask for no more than the least height: the views share what there is."""
        return self.minimumHeight()

    def add(self, name: str, title: str, page: QWidget) -> None:
        """Add a half."""
        button = QPushButton(title)
        button.setCheckable(True)
        button.setProperty("role", "tab")
        self._buttons.addButton(button, len(self._names))
        self._row.insertWidget(len(self._names), button)
        self._names.append(name)
        self._halves.append(page)
        self._stack.addWidget(page)
        self._bar.setVisible(len(self._names) > 1)
        self._buttons.button(self._stack.currentIndex()).setChecked(True)

    def take_out(self) -> None:
        """Take the halves out, so that the page is put into a window without them."""
        for half in self._halves:
            self._stack.removeWidget(half)
            half.setParent(None)

    def put_back(self) -> Iterator[None]:
        """Put the halves back, one at a time: each takes the window's style sheet then."""
        for half in self._halves:
            self._stack.addWidget(half)
            yield

    @property
    def front(self) -> str:
        """Name of the half that is shown."""
        return self._names[self._stack.currentIndex()]

    def tell(self, entered: Callable[[str], None]) -> None:
        """Have ``entered`` called with the name of a half that comes to the front."""
        self._entered = entered

    def show_half(self, name: str) -> None:
        """Bring a half to the front, and tell."""
        self.bring(name)
        self._entered(name)

    def bring(self, name: str) -> None:
        """Bring a half to the front of a page that may not be in front itself."""
        at = self._names.index(name)
        self._stack.setCurrentIndex(at)
        self._buttons.button(at).setChecked(True)


def _nothing(_name: str) -> None:
    """Do nothing: nobody asked to be told."""
