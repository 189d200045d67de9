"""Find texts cut off, overlaps and controls out of reach in a window (``make screens CHECK=1``).

Sizes are those of a screen in physical pixels; a scale divides them into logical ones. Painted
texts are those that Python code draws; elided texts count where digits are lost.
"""

from __future__ import annotations

import ast
import json
import math
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import combinations, product
from pathlib import Path
from typing import Any
from unittest import mock

from PySide6.QtCore import QPoint, QPointF, QRect, QRectF, QSize, Qt, QTranslator
from PySide6.QtGui import QFontMetrics, QFontMetricsF, QPainter
from PySide6.QtWidgets import (
    QAbstractButton,
    QAbstractItemView,
    QAbstractScrollArea,
    QAbstractSpinBox,
    QApplication,
    QComboBox,
    QFileDialog,
    QHeaderView,
    QLabel,
    QLineEdit,
    QMenu,
    QPushButton,
    QScrollBar,
    QSizeGrip,
    QSplitterHandle,
    QStyle,
    QStyledItemDelegate,
    QStyleOptionButton,
    QTableView,
    QToolButton,
    QWidget,
)
from shiboken6 import isValid

from touchdown.widgets.base import ElidedLabel
from touchdown.widgets.base.panel import CONTEXT
from touchdown.widgets.shell.tour import TourCard

SIZES = ((800, 600), (1024, 768), (1280, 720), (1366, 768), (1600, 940), (2560, 1440))
SCALES = (1.0, 1.25, 1.5, 2.0)
STARTS = (1600, 940)  # size of the window in which the states arise
STATE_AND_STOP = (800, 600)  # only these two have to be visible at this size
SLACK_PX = 2
ARROW_PX, MOST_DIGITS, MOST_ROWS = 22, 16, 12
TOUCH_PX = 1.5  # texts whose boxes overlap by less do not touch
DIGIT = re.compile(r"(?<![A-Za-z\d])\d")  # no key such as F1
SCROLLS = Qt.ScrollBarPolicy.ScrollBarAlwaysOff


@dataclass(frozen=True, slots=True)
class PaintedText:
    """One call of ``drawText``: the device, the box of the text on it, and the text."""

    device: object
    box: QRectF
    text: str
    cut: bool


class PaintRecorder:
    """Records the texts that are painted or elided while it is active."""

    def __init__(self) -> None:
        self.painted: list[PaintedText] = []
        self.elided: set[tuple[str, str]] = set()

    @contextmanager
    def __call__(self) -> Iterator[None]:
        draw = QPainter.drawText

        def draw_text(painter: QPainter, *args: Any) -> Any:
            self._note(painter, args)
            return draw(painter, *args)

        with (
            mock.patch.object(QPainter, "drawText", draw_text),
            mock.patch.object(QFontMetrics, "elidedText", self._eliding(QFontMetrics)),
            mock.patch.object(QFontMetricsF, "elidedText", self._eliding(QFontMetricsF)),
        ):
            yield

    def _eliding(self, kind: Any) -> Callable[..., str]:
        elide = kind.elidedText

        def elided_text(metrics: Any, text: str, *args: Any) -> str:
            shown: str = elide(metrics, text, *args)
            if shown != text:
                self.elided.add((text, shown))
            return shown

        return elided_text

    def _note(self, painter: QPainter, args: tuple[Any, ...]) -> None:
        text = next(one for one in args if isinstance(one, str))
        first, metrics = args[0], QFontMetricsF(painter.font())
        room = None
        if isinstance(first, QRect | QRectF):
            room = QRectF(first)
            flags = int(args[1]) if not isinstance(args[1], str) else 0
            box = QRectF(painter.boundingRect(room, flags, text))
            room = None if flags & int(Qt.TextFlag.TextDontClip) else room
        else:
            at = QPointF(first) if isinstance(first, QPoint | QPointF) else QPointF(*args[:2])
            width = metrics.horizontalAdvance(text)
            box = QRectF(at.x(), at.y() - metrics.ascent(), width, metrics.height())
        cut = room is not None and box.width() > room.width() + SLACK_PX
        if text.strip():
            box = painter.combinedTransform().mapRect(box)
            self.painted.append(PaintedText(painter.device(), box, text, cut))


def logical_sizes() -> Iterator[tuple[str, QSize, bool]]:
    """Yield name, size in logical pixels and whether the whole window is checked there."""
    for width, height in SIZES:
        for scale in SCALES:
            size = QSize(int(width / scale), int(height / scale))
            yield f"{width}x{height}@{scale:g}", size, (width, height) != STATE_AND_STOP


ACCENTS = str.maketrans(
    "aeiouAEIOUcn", "\u00e5\u00eb\u00ef\u00f6\u00fc\u00c5\u00cb\u00cf\u00d6\u00dc\u00e7\u00f1"
)
MARKED = re.compile(f"[{''.join(map(chr, ACCENTS.values()))}]")
LONGER = 0.3  # share by which a translation may be longer than the English text


def pseudo_text(text: str) -> str:
    """Return a text with words as in a long translation: accented, 30 % longer."""
    if not re.search(r"[A-Za-z]{3}", text) or "\n" in text:
        return text
    more = math.ceil(LONGER * len(text))
    added = "\u00f6" * more if " " not in text else (" \u00fcnd m\u00ebhr" * more)[:more]
    # Fields such as {:.1f} stay as they are.
    parts = re.split(r"(\{[^{}]*\})", text)
    return "".join(p if p[:1] == "{" else p.translate(ACCENTS) for p in parts) + added


class PseudoTranslator(QTranslator):
    """Translates the texts that the window gives for translation into pseudo texts."""

    def translate(self, context: str, text: str, *_: object) -> str:
        """Return the pseudo text of an extracted text, else the text itself."""
        return pseudo_text(text) if context == CONTEXT and text in window_texts() else text


# Functions that translate some arguments, by position; elements of their tuples by position.
GIVEN = {
    "tr": (0,), "label": (0,), "Panel": (0,), "CaptionedView": (0,), "__init__": (0,),
    "rename": (0,), "show_message": (0,), "say": (0,), "flat_button": (0, 1), "HoldButton": (0, 2),
    "compact_combo_box": (0, 1), "draw_message": (3, 4), "WindowCommand": (1,), "on": (1,),
    "ask": (0, 1, 2), "TourStop": (2, 3), "CardText": (1, 2, 3), "CardQuestion": (0,),
    "DecisionText": (0, 3), "TrialPrompt": (0, 1, 2), "ProbeText": (0,),
}  # fmt: skip
ROWS = {"describe": (1, 2), "add_wide": (0, 2, 3), "add_halves": (0, 2, 3), "set_entries": (1,)}
CODE = Path(__file__).resolve().parents[1]


@cache
def window_texts() -> frozenset[str]:
    """Return the literals of ``app`` and ``widgets`` that are translated or stand in tables."""
    texts = set[str]()
    for path in sorted(path for name in ("app", "widgets") for path in (CODE / name).rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                texts |= {
                    text for text in _literals(node.value) if text[0].isupper() or " " in text
                }
        for call in ast.walk(tree):
            if isinstance(call, ast.Call):
                name = getattr(call.func, "attr", getattr(call.func, "id", ""))
                rows = [row.elts for arg in call.args for row in ast.walk(arg)
                        if name in ROWS and isinstance(row, ast.Tuple)]  # fmt: skip
                for row, places in ((call.args, GIVEN), *((row, ROWS) for row in rows)):
                    for at in places.get(name, ()):
                        texts |= set(_literals(row[at])) if at < len(row) else set()
    return frozenset(texts)


def _literals(node: ast.AST) -> Iterator[str]:
    """Yield the texts of an expression, without those that it compares with or formats."""
    if isinstance(node, ast.Constant):
        if isinstance(node.value, str) and re.search(r"[A-Za-z]{2}", node.value):
            yield node.value
    elif not isinstance(node, ast.JoinedStr | ast.Compare):
        for child in ast.iter_child_nodes(node):
            yield from _literals(child)


def write_texts(file: Path) -> None:
    """Write or update a file of translations for Qt Linguist; present translations stay."""
    with tempfile.TemporaryDirectory() as folder:
        listing = Path(folder) / "texts.py"
        given = (f"{json.dumps(CONTEXT)}, {json.dumps(text)}" for text in sorted(window_texts()))
        listing.write_text("".join(f"QCoreApplication.translate({one})\n" for one in given))
        command = ["pyside6-lupdate", str(listing), "-locations", "none", "-ts", str(file)]
        subprocess.run(command, check=True)


@contextmanager
def pseudo_texts(untranslated: set[str]) -> Iterator[None]:
    """Show all labels and buttons in pseudo texts, then in their own ones again.

    Adds the texts that did not go through the translation to ``untranslated``.
    """
    changed = list[tuple[Any, str, str]]()
    for widget in QApplication.allWidgets():
        if isinstance(widget, QLabel | QAbstractButton) and widget.isVisible():
            text = widget.text()
            if not MARKED.search(text):
                widget.setText(pseudo_text(text))
                changed.append((widget, text, widget.text()))
                untranslated |= {text} - {widget.text()}
    try:
        yield
    finally:
        for widget, text, shown in changed:
            if isValid(widget) and widget.text() == shown:
                widget.setText(text)


def view_failures(window: QWidget, size: QSize, *, whole: bool = True) -> list[str]:
    """Resize a window to a screen of ``size`` and return what is wrong there, one line each.

    ``whole`` False: only state and STOP of the top bar are looked at.
    """
    recorder = PaintRecorder()
    tops = [one for one in QApplication.topLevelWidgets() if one.isVisible() and one is not window]
    with recorder():
        window.resize(size)
        for top in tops:
            usual = top.property("usual") or top.size()
            top.setProperty("usual", usual)
            # As a sheet that is opened in a window of this size.
            top.setMinimumWidth(min(top.minimumWidth(), size.width()))
            top.resize(usual.boundedTo(size))
        for _ in range(8):  # layouts settle in a few rounds
            QApplication.processEvents()
        drawn = [one for one in recorder.painted if not isinstance(one.device, QWidget)]
        recorder.painted[:] = drawn
        window.grab()
        for top in tops:
            top.grab()
    screen = QRect(QPoint(), size)
    if not whole:
        bar = window._bar  # type: ignore[attr-defined]
        return [line for part in (bar.pill, bar.stop) for line in _reach(part, window, screen)]
    found = list(_painted_failures(recorder))
    for top in (window, *tops):
        if not isinstance(top, QMenu | QFileDialog):
            found += _widget_failures(top, screen)
    return list(dict.fromkeys(found))


def _widget_failures(top: QWidget, screen: QRect) -> Iterator[str]:
    for widget in (top, *top.findChildren(QWidget)):
        if not widget.isVisible() or widget.window() is not top:
            continue
        if _is_control(widget):
            yield from _reach(widget, top, screen)
        yield from _cut(widget)
        yield from _overlaps(widget)


def _name(widget: QWidget) -> str:
    text = getattr(widget, "text", None)
    words = text() if callable(text) else ""
    words = words or widget.accessibleName() or widget.objectName()
    return f"{type(widget).__name__} '{' '.join(str(words).split())[:60]}'"


def _is_control(widget: QWidget) -> bool:
    kinds = QAbstractButton | QComboBox | QLineEdit | QAbstractSpinBox
    if isinstance(widget, QScrollBar | QHeaderView | QSplitterHandle):
        return False
    inner = isinstance(widget.parentWidget(), QComboBox | QAbstractSpinBox | QLineEdit | QTableView)
    return not inner and (
        isinstance(widget, kinds) or bool(widget.focusPolicy() & Qt.FocusPolicy.TabFocus)
    )


def _reach(widget: QWidget, top: QWidget, screen: QRect) -> Iterator[str]:
    """Yield a line if a part of the widget can be neither seen nor reached by scrolling."""
    rect, at = widget.rect(), widget
    while at is not top:
        rect, at = rect.translated(at.pos()), at.parentWidget()
        area = at.parentWidget()
        room = at.rect()
        if isinstance(area, QAbstractScrollArea) and at is area.viewport():
            # Scrolled into view: only what is larger than the viewport is lost.
            if area.horizontalScrollBarPolicy() != SCROLLS or _inside(area.horizontalScrollBar()):
                rect = QRect(0, rect.y(), min(rect.width(), room.width()), rect.height())
            if area.verticalScrollBarPolicy() != SCROLLS:
                rect = QRect(rect.x(), 0, rect.width(), min(rect.height(), room.height()))
        elif at is top:
            room = room.intersected(screen)
        seen = rect.intersected(room)
        lost = max(rect.width() - seen.width(), rect.height() - seen.height())
        if lost > SLACK_PX and not rect.isEmpty():
            yield f"off the screen: {_name(widget)} by {lost} px, in {_name(at)}"
            return


def _inside(bar: QScrollBar) -> bool:
    return bar.maximum() > bar.minimum()


def _cut(widget: QWidget) -> Iterator[str]:
    """Yield a line if the text of a standard widget does not fit it."""
    if isinstance(widget, QLabel):
        # What an elided label leaves out is recorded when it is painted.
        yield from () if isinstance(widget, ElidedLabel) else _cut_label(widget)
    elif isinstance(widget, QHeaderView | QTableView):
        yield from _cut_cells(widget)
    else:
        text, needed, room = _line_of(widget)
        if text.strip() and needed > room + SLACK_PX:
            yield f"cut off: {_name(widget)}: '{text[:60]}' needs {needed} of {room} px"


def _line_of(widget: QWidget) -> tuple[str, int, int]:
    """Return text, its width and the room for it of a control of one line."""
    metrics, text, room = widget.fontMetrics(), "", 0
    if isinstance(widget, QPushButton):
        option = QStyleOptionButton()
        widget.initStyleOption(option)
        part = QStyle.SubElement.SE_PushButtonContents
        room = widget.style().subElementRect(part, option, widget).width()
        room -= 0 if widget.icon().isNull() else widget.iconSize().width() + 4
        text = widget.text()
    elif isinstance(widget, QToolButton):
        shown = widget.toolButtonStyle() != Qt.ToolButtonStyle.ToolButtonIconOnly
        text, room = widget.text() if shown else "", widget.width() - 4
    elif isinstance(widget, QComboBox) and not widget.isEditable():
        text, room = widget.currentText(), widget.width() - ARROW_PX
    elif isinstance(widget, QAbstractSpinBox):
        text, room = widget.text(), widget.lineEdit().contentsRect().width()
    elif isinstance(widget, QLineEdit) and len(widget.text()) < MOST_DIGITS:
        text, room = widget.text(), widget.contentsRect().width()
    return text, metrics.size(int(Qt.TextFlag.TextShowMnemonic), text).width(), room


def _cut_cells(view: QHeaderView | QTableView) -> Iterator[str]:
    model, along = view.model(), Qt.Orientation.Horizontal
    cells: list[tuple[str, int, int]] = []
    if model is None:
        return
    if isinstance(view, QTableView):
        if type(view.itemDelegate()) is not QStyledItemDelegate:
            return  # recorded when it is painted
        for row, at in product(range(min(model.rowCount(), MOST_ROWS)), range(model.columnCount())):
            text = str(model.index(row, at).data() or "")
            room = 0 if view.isColumnHidden(at) or not DIGIT.search(text) else view.columnWidth(at)
            cells.append((text, view.fontMetrics().horizontalAdvance(text), room))
    elif view.orientation() == along:
        for at in range(view.count()):
            text = str(model.headerData(at, along) or "")
            room = 0 if view.isSectionHidden(at) else view.sectionSize(at)
            widest = max(map(view.fontMetrics().horizontalAdvance, text.split("\n")))
            cells.append((text, widest, room))
    for text, needed, room in cells:
        if room and text.strip() and needed > room + SLACK_PX:
            yield f"cut off: cell of {_name(view)}: '{text[:60]}' needs {needed} of {room} px"


def _cut_label(label: QLabel) -> Iterator[str]:
    text, room = label.text(), label.contentsRect()
    if not text.strip() or not label.pixmap().isNull():
        return
    if label.wordWrap():
        needed = label.heightForWidth(label.width())
        if needed > label.height() + SLACK_PX:
            what = f"needs {needed} of {label.height()} px of height"
            yield f"cut off: {_name(label)}: {what}"
        return
    size = label.fontMetrics().size(0, text)
    if size.width() > room.width() + SLACK_PX:
        yield f"cut off: {_name(label)}: needs {size.width()} of {room.width()} px"
    elif size.height() > room.height() + 2 * SLACK_PX:
        yield f"cut off: {_name(label)}: needs {size.height()} of {room.height()} px of height"


def _overlaps(parent: QWidget) -> Iterator[str]:
    if isinstance(parent, QAbstractScrollArea | QComboBox | QAbstractSpinBox | QLineEdit):
        return
    if isinstance(parent.parentWidget(), QAbstractItemView):
        return
    children = [
        one for one in parent.children()
        if isinstance(one, QWidget) and one.isVisible() and not one.isWindow()
        and not isinstance(one, QSizeGrip | QSplitterHandle | TourCard)
        and not one.testAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
    ]  # fmt: skip
    for one, other in combinations(children, 2):
        shared = one.geometry().intersected(other.geometry())
        if min(shared.width(), shared.height()) > SLACK_PX:
            by_px = min(shared.width(), shared.height())
            yield f"overlap: {_name(one)} and {_name(other)} by {by_px} px"


def _painted_failures(recorder: PaintRecorder) -> Iterator[str]:
    for text, shown in sorted(recorder.elided):
        # Digits in what an ellipsis stands for.
        begins, _, ends = shown.partition("\N{HORIZONTAL ELLIPSIS}")
        lost = range(len(begins), len(text) - len(ends))
        if any(digit.start() in lost for digit in DIGIT.finditer(text)):
            yield f"elided: '{text}' to '{shown}'"
    by_device: dict[int, list[PaintedText]] = {}
    for one in recorder.painted:
        by_device.setdefault(id(one.device), []).append(one)
    for texts in by_device.values():
        where = _place(texts[0].device)
        unique = list({(one.text, one.box.toRect().getRect()): one for one in texts}.values())
        for one in unique:
            if one.cut or _leaves(one):
                yield f"cut off: painted '{one.text[:60]}' on {where}"
        for one, other in combinations(unique, 2):
            if one.text != other.text and _touch(one.box, other.box):
                yield f"overlap: painted '{one.text[:40]}' and '{other.text[:40]}' on {where}"


def _leaves(one: PaintedText) -> bool:
    device = one.device
    if not isinstance(device, QWidget) or isinstance(device.parentWidget(), QAbstractScrollArea):
        return False
    room = QRectF(device.rect()).adjusted(-SLACK_PX, -3, SLACK_PX, 3)
    return not room.contains(one.box)


def _touch(one: QRectF, other: QRectF) -> bool:
    # A font leaves room above and below its digits.
    down = 0.2 * min(one.height(), other.height())
    shared = one.intersected(other)
    return shared.width() > TOUCH_PX and shared.height() > down + TOUCH_PX


def _place(device: object) -> str:
    return _name(device) if isinstance(device, QWidget) else "a picture"
