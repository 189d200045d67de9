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
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import combinations, product
from pathlib import Path
from typing import Any
from unittest import mock

from PySide6.QtCore import (
    QAbstractListModel,
    QPoint,
    QPointF,
    QRect,
    QRectF,
    QSize,
    Qt,
    QTranslator,
)
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
    QPlainTextEdit,
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

from touchdown.backend.annotations import REJECT_REASONS
from touchdown.backend.calibration import CALIBRATION_KINDS, QUANTITIES
from touchdown.backend.core import FINGERS, Outcome, SupportKind
from touchdown.backend.devices import CONNECTION_STEPS, NAMES, DeviceState, RobotMode, SafetyMode
from touchdown.backend.geometry import load_pieces
from touchdown.widgets.base import ROOT, ElidedLabel
from touchdown.widgets.base.panel import CONTEXT
from touchdown.widgets.forms import STRATEGIES
from touchdown.widgets.lists.recordings import STATE_COLOURS
from touchdown.widgets.shell.tour import TourCard
from touchdown.widgets.views import ReportSheet
from touchdown.widgets.views.offset import GHOST_STYLES

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
    if not re.search(r"[A-Za-z]{2}", text) or "<" in text:
        return text
    more = math.ceil(LONGER * len(text))
    added = "\u00f6" * more if " " not in text else (" \u00fcnd m\u00ebhr" * more)[:more]
    # Fields such as {:.1f} stay as they are.
    parts = re.split(r"(\{[^{}]*\}|%[nvm])", text)
    return "".join(p if p[:1] in ("{", "%") else p.translate(ACCENTS) for p in parts) + added


class PseudoTranslator(QTranslator):
    """Translates the texts that the window gives for translation into pseudo texts."""

    def translate(self, context: str, text: str, *_: object) -> str:
        """Return the pseudo text of an extracted text, else the text itself."""
        known = text in window_texts() or text.removeprefix("%n ")[:-1] in counted_nouns()
        return pseudo_text(text) if context == CONTEXT and known else text


# Functions with literals that nobody reads.
UNREAD = frozenset(
    ["getLogger", "debug", "info", "warning", "error", "exception", "setObjectName", "setProperty",
     "property", "set_property", "add_argument", "ArgumentParser", "ArgumentTypeError", "cast",
     "setdefault", "setenv", "getattr", "ValueError", "KeyError", "NotImplementedError", "sub",
     "compile", "search", "match", "fullmatch", "Thread", "count_noun"]
)  # fmt: skip
CODE_FIRST = frozenset(["CardText", "error_card", "RefusedError"])  # their first argument is a code
NO_WORD = re.compile(
    r"[A-Z]+(-[A-Z]+)+|((Ctrl|Shift|Alt)\+)+\S+|[\w.]*_[\w.]*|Pg(Up|Down)|\*?\.\w+"
)
# Words that the sources of the window do not tell from codes: states, headers, legends.
RUN_WORDS = ("approach", "touch", "press", "hold", "lift", "shift", "unload", "release", "rise",
             "grip", "reference", "weigh", "cancelled", "stopped", "failed", "finished", "silent",
             "slow", "late", "label", "bottom", "scene", "random", "grid",
             "adaptive", "stable", "unstable", "unsure", "record", "set", "accept", "approve",
             "reject", "accept next", "take over", "opinion", "undo", "redo", "flag", "delete",
             "restore", "resolve", "move", "knocked over", "gave up", "placed", "fell", "aborted",
             "dark", "light", "probing", "collecting", "all", "degrees", "millimetres", "done",
             "open", "now", "simulated", "emulated", "lab", "running", "succeeded", "interrupted",
             "keep", "discard", "skip", "degraded", "stale", "active", "any", "auto", "new",
             "nothing", "target", "step", "face", "source", "type", "numbers",
             "messages", "optimiser", "quantity", "value", "limits", "parameter", "run",
             "state", "sees", "epoch", "setting", "units", "layers", "rate", "schedule", "epochs",
             "patience", "keeps", "batch", "seed", "piece", "labels", "best", "received", "lost",
             "maker", "model", "serial", "firmware", "noise", "offset", "markers", "used", "sigma",
             "grey", "commanded", "measured", "human", "signals", "conflict", "yes", "no",
             "stepped", "refused", "kept", "Mass",  "none", "moving", "empty")  # fmt: skip
CODE = Path(__file__).resolve().parents[1]


@cache
def window_texts() -> frozenset[str]:
    """Return the literals of ``app`` and ``widgets`` that the window shows, each in one language.

    These are the first arguments of ``tr``, all literals with two words or a capital, and the
    words of ``backend`` that name states.
    """
    texts = set(_words_of_states())
    for path in sorted(path for name in ("app", "widgets") for path in (CODE / name).rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        texts.update(text for text in _literals(tree) if _is_prose(text))
        for call in ast.walk(tree):
            if isinstance(call, ast.Call) and _called(call) == "tr":
                texts.update(_literals(call.args[0]))
    return frozenset(texts)


@cache
def counted_nouns() -> frozenset[str]:
    """Return the nouns of ``count_noun`` in ``app`` and ``widgets``."""
    nouns = set[str]()
    for path in (path for name in ("app", "widgets") for path in (CODE / name).rglob("*.py")):
        for call in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(call, ast.Call) and _called(call) == "count_noun":
                nouns.update(_literals(call.args[1]))
    return frozenset(nouns)


def _words_of_states() -> Iterator[str]:
    for states in (DeviceState, RobotMode, SafetyMode, Outcome, SupportKind):
        yield from (state.value for state in states)
    yield from (kind.title for kind in CALIBRATION_KINDS.values())
    yield from (part for name in QUANTITIES for part in name.split("_"))
    yield from (*CONNECTION_STEPS, *REJECT_REASONS)
    yield from (*RUN_WORDS, *FINGERS, *NAMES.values(), *STATE_COLOURS, *GHOST_STYLES)


def _is_prose(text: str) -> bool:
    return (" " in text.strip() or text.lstrip("&")[0].isupper()) and not NO_WORD.fullmatch(text)


def _called(call: ast.Call) -> str:
    return str(getattr(call.func, "attr", getattr(call.func, "id", "")))


def _literals(node: ast.AST) -> Iterator[str]:
    """Yield the texts of some code, without those that it compares with, formats or only logs."""
    if isinstance(node, ast.Constant):
        if isinstance(node.value, str) and re.search(r"[A-Za-z]{2}", node.value):
            yield node.value
        return
    left_out: list[object] = []
    if isinstance(node, ast.JoinedStr | ast.Compare | ast.Subscript):
        return
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return  # a docstring
    if isinstance(node, ast.Call) and _called(node) in UNREAD:
        return
    if isinstance(node, ast.Call) and _called(node) in CODE_FIRST:
        left_out = [*node.args[:1]]
    if isinstance(node, ast.Call) and _called(node) == "carry_out":
        left_out = [*node.args[2:]]
    if isinstance(node, ast.FunctionDef | ast.arg | ast.AnnAssign):
        left_out = [getattr(node, "returns", None), getattr(node, "annotation", None)]
    for child in ast.iter_child_nodes(node):
        if child not in left_out:
            yield from _literals(child)


def write_texts(file: Path) -> None:
    """Write or update a file of translations for Qt Linguist; present translations stay."""
    with tempfile.TemporaryDirectory() as folder:
        listing = Path(folder) / "texts.py"
        context = json.dumps(CONTEXT)
        given = [f"{context}, {json.dumps(text)}" for text in sorted(window_texts())]
        given += [f'{context}, "%n {noun}s", None, 1' for noun in sorted(counted_nouns())]
        listing.write_text("".join(f"QCoreApplication.translate({one})\n" for one in given))
        tool = Path(sys.executable).with_name("pyside6-lupdate")
        command = [str(tool), str(listing), "-locations", "none", "-ts", str(file)]
        subprocess.run(command, check=True)


# Names, keys and terms that are the same in every language.
DATA = frozenset(
    ["Ann", "Bo", "setup", "root", "packs", "Bench", "stand", "in", "Touchdown", "IoU", "Enter",
     "Esc", "Space", "Backspace", "Tab", "PgUp", "PgDown", "XYZ", "TOOL", "JOINT", "cividis",
     "viridis", "cosine", "drift", "min", "bota", "dynpick", "leptrino", "melfa", "netft",
     "optoforce", "ur", "Tac", "arm",
     "Adam", "CompressedImage", "PoseStamped", "WrenchStamped",
     "Maker", "Model", "Jan", "Feb", "Apr", "Jun", "Aug", "Oct", "Nov",
     "Dec"]
)  # fmt: skip
WORD = re.compile(r"[^\W\d_]+(?:['\u2019][^\W\d_]+)?")
NAMED = re.compile(
    r"<[^<>]*>|\S*[\d_/\\.]\S*[\w/]|'[^']*'|\b(?:Ctrl|Alt|Shift)\+\S+|\[[A-Za-z-]+\]"
    r"|(?<=\d) to (?=[\d\u2212-])"
)
TOKEN = re.compile(rf"\d|\0|{WORD.pattern}")
FIELD = re.compile(r"\{[^{}]*\}|%s")


@cache
def backend_texts() -> list[tuple[str, re.Pattern[str]]]:
    """Return the texts of ``backend``, ``resources`` and the stand-in bench, from three words on.

    Each has its longest part without fields.
    """
    texts = set[tuple[str, ...]]()
    tests = (*(CODE / "tests").glob("screen*.py"), CODE / "tests" / "app" / "stand_in.py")
    for path in (*(CODE / "backend").rglob("*.py"), *tests):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.add(tuple(FIELD.split(node.value)))
            elif isinstance(node, ast.JoinedStr):
                parts = [getattr(part, "value", "") for part in node.values]
                texts.add(tuple(part if isinstance(part, str) else "" for part in parts))
    for path in sorted((CODE / "resources").rglob("*.toml")):
        texts.update((line,) for line in re.findall('"([^"]*)"', path.read_text("utf-8")))
    found = []
    for parts in texts:
        lower = [part.strip(" .:\n").lower() for part in parts]
        longest = max(lower, key=len)
        if len(WORD.findall(longest)) > 1 and len(WORD.findall(" ".join(lower))) > 2:
            found.append((longest, re.compile(".*?".join(map(re.escape, filter(None, lower))))))
    return sorted(found, key=lambda one: -len(one[1].pattern))


@cache
def plain_words(text: str) -> tuple[str, ...]:
    """Return the English phrases of a shown text that no translation has changed.

    Names, numbers and texts of the backend are data.
    """
    if not any(map(_is_plain, WORD.findall(NAMED.sub(" ", text)))):
        return ()
    for part, pattern in backend_texts():
        if part in text.lower():
            text = "".join(_left(text, pattern))
    found, words, beside = list[str](), list[str](), False
    for word in [*TOKEN.findall(NAMED.sub(" 0 ", text)), ""]:
        if _is_plain(word):
            words.append(word)
            continue
        # Short parts of a text of the backend stand beside a long one, or before a number.
        short = beside or word == "\0" or word.isdigit()
        part = short and {one.lower() for one in words} <= backend_words()
        if words and not part:
            found.append(" ".join(words))
        words, beside = [], word == "\0" or (beside and word.isdigit())
    return tuple(found)


@cache
def backend_words() -> frozenset[str]:
    """Return the words of ``backend`` that stand alone between two fields of a text."""
    texts = (p.read_text("utf-8") for p in (CODE / "backend").rglob("*.py"))
    parts = (part for text in texts for part in re.findall(r"[\"'}]([^\"'{}\n]{2,40})[\"'{]", text))
    return frozenset(word.lower() for part in parts for word in WORD.findall(part))


def _left(text: str, pattern: re.Pattern[str]) -> Iterator[str]:
    """Yield the parts of a text between the matches of a pattern in lower case."""
    end = 0
    for found in pattern.finditer(text.lower()):
        yield f"{text[end : found.start()]} \0 "
        end = found.end()
    yield text[end:]


@cache
def piece_names() -> frozenset[str]:
    """Return the words of the names and titles of pieces, and of strategies."""
    pieces = load_pieces().pieces.values()
    names = " ".join([*(f"{p.name} {p.title}" for p in pieces), *(key for key, _ in STRATEGIES)])
    return frozenset(WORD.findall(names))


def _is_plain(word: str) -> bool:
    """Return True for an English word; words without a vowel are units and symbols."""
    has_vowel = len(word) > 1 and re.search("[aeiouAEIOU]", word) is not None
    return has_vowel and not MARKED.search(word) and word not in DATA | piece_names()


READERS = ("text", "title", "placeholderText", "toPlainText", "suffix", "specialValueText",
           "toolTip", "accessibleName", "accessibleDescription")  # fmt: skip


def shown_texts(window: QWidget) -> Iterator[tuple[str, str]]:
    """Yield the texts of all visible widgets of a window, each with the name of its widget."""
    yield "title", window.windowTitle()
    for widget in (window, *window.findChildren(QWidget)):
        if widget.isVisible() and widget.window() is window and not _is_data(widget):
            readers = (getattr(widget, name, None) for name in READERS)
            texts = [read() for read in readers if callable(read)]
            texts += [text for action in widget.actions() for text in (action.text(),)]
            if isinstance(widget, QComboBox):
                texts += [widget.itemText(k) for k in range(widget.count())]
            elif isinstance(widget, QAbstractItemView) and widget.model() is not None:
                texts += _cells(widget)
            yield from ((_name(widget), text) for text in texts if isinstance(text, str))


def _is_data(device: object) -> bool:
    """Return True for an editor of text, or a part of a report, whose texts come from a file."""
    if not isinstance(device, QWidget):
        tops = QApplication.topLevelWidgets()
        return any(isinstance(top, ReportSheet) and top.isVisible() for top in tops)
    if any(isinstance(one, QPlainTextEdit) for one in (device, device.parentWidget())):
        return True
    sheet = device.window()
    return isinstance(sheet, QFileDialog) or (
        isinstance(sheet, ReportSheet)
        and any(
            part is device or part.isAncestorOf(device)
            for part in (sheet.room, sheet.head, sheet.banner, sheet.file, sheet.parts)
        )
    )


def _cells(view: QAbstractItemView) -> Iterator[str]:
    model, role = view.model(), Qt.ItemDataRole
    columns = 1 if isinstance(model, QAbstractListModel) else model.columnCount(ROOT)
    for kind in (role.DisplayRole, role.ToolTipRole, role.AccessibleTextRole):
        for at in range(columns):
            yield model.headerData(at, Qt.Orientation.Horizontal, kind)
        for row, at in product(range(min(model.rowCount(ROOT), MOST_ROWS)), range(columns)):
            yield model.index(row, at).data(kind)


def untranslated(state: str) -> dict[str, str]:
    """Return the visible texts of all windows that stayed English in the pseudo-locale.

    Each text has the names of ``state`` and of its widget.
    """
    recorder, found = PaintRecorder(), dict[str, str]()
    tops = [one for one in QApplication.topLevelWidgets() if one.isVisible()]
    with recorder():
        for top in tops:
            top.grab()
    texts = [(_place(p.device), p.text) for p in recorder.painted if not _is_data(p.device)]
    texts += [("elided", text) for text, _ in recorder.elided]
    for top in tops:
        if not isinstance(top, QFileDialog):
            texts += shown_texts(top)
    for name, text in texts:
        if plain_words(text):
            found.setdefault(text, f"{state}, {name}: {'; '.join(plain_words(text))}")
    return found


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
