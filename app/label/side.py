"""Side panel: agreement, bulk changes, entry of numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations

from PySide6.QtCore import QEvent, Qt
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import (
    QButtonGroup,
    QComboBox,
    QLineEdit,
    QListWidget,
    QStackedWidget,
    QWidget,
)

from touchdown.backend.annotations import (
    PROGRAM_ACTOR,
    AgreementReport,
    Dataset,
    SuggestionBias,
    compare_with_control_items,
    suggestion_bias,
)
from touchdown.widgets.base import (
    Panel,
    Theme,
    WrappedItemDelegate,
    count_noun,
    hbox,
    label,
    push_button,
    scroll_area,
    signed,
    tr,
    vbox,
)
from touchdown.widgets.lists import HistoryList
from touchdown.widgets.plots import RUN_COLOURS, CurveLine, CurvePlot

MOST_PERIODS = 12  # newest periods of the agreement over time
LEAST = 2  # one common episode gives no agreement figures


def agreement_figures(dataset: Dataset) -> tuple[str, list[CurveLine]]:
    """Return the agreement of a dataset as text, and its course over time, a curve per pair.

    Slow: do not call on the thread of the window.
    """
    people = sorted(name for name in dataset.people() if name != PROGRAM_ACTOR)
    parts, lines = [], list[CurveLine]()
    for first, second in combinations(people, 2):
        found = dataset.compare(first, second)
        if found.episodes >= LEAST:
            parts.append(pair_agreement_text(first, second, found))
            points = tuple(
                (n, rms) for n, (_, _, rms) in enumerate(found.periods[-MOST_PERIODS:], 1)
            )
            if len(points) > 1:
                token = RUN_COLOURS[len(lines) % len(RUN_COLOURS)]
                dashed = len(lines) >= len(RUN_COLOURS)
                lines.append(CurveLine(f"{first}, {second}", points, token, dashed))
    for person in people:
        gold = compare_with_control_items(dataset.database, dataset.geometry, person)
        if gold.episodes:
            parts.append(pair_agreement_text(tr("{} on gold", person), tr("approved label"), gold))
    swayed = suggestion_bias(dataset.database, people)
    if swayed.episodes >= LEAST:
        parts.append(suggestion_bias_text(swayed))
    return "\n\n".join(parts) or tr(NO_AGREEMENT), lines


NO_AGREEMENT = (
    "No two people have answered the same episodes yet.\n\nOne unlabelled episode in 20 is gold: "
    "it has an approved label of another person and looks like the others. Your decision there is "
    "stored as an opinion, as in the queue 'Gold': it changes no label."
)


def pair_agreement_text(first: str, second: str, c: AgreementReport) -> str:
    """Return the agreement of two persons; unknown figures are left out."""
    lines = [tr("{} minus {}, {}", first, second, count_noun(c.episodes, "episode"))]
    for axis, bias, icc in (("x", c.bias_x_mm, c.icc_x), ("y", c.bias_y_mm, c.icc_y)):
        if not math.isnan(bias.mean):
            said = (
                tr("{}: bias {} mm", axis, signed(bias.mean)),
                _limits(bias.lower, bias.upper),
                _figure("ICC", icc),
            )
            lines.append(", ".join(filter(None, said)))
    rest = [
        _figure("RMS", c.rms_mm, "{:.2f} mm"),
        _figure("patch IoU", 100 * c.patch_iou, "{:.0f} %"),
        _figure("stability: kappa", c.kappa),
        _figure("alpha", c.alpha),
    ]
    lines.append(", ".join(part for part in rest if part))
    if not any(map(math.isnan, c.drift_mm)):
        lines.append(tr("drift x {}, y {} mm", signed(c.drift_mm[0]), signed(c.drift_mm[1])))
    if len(c.periods) > 1:
        newest = enumerate(c.periods[-MOST_PERIODS:], start=1)
        of = "{}. {}: {:.2f} mm of {}"
        periods = [tr(of, n, name, rms, count) for n, (name, count, rms) in newest]
        lines += [tr("RMS over time:"), *periods]
    times = [f"{seconds:.1f} s" for seconds in c.seconds if not math.isnan(seconds)]
    if times and not math.isnan(c.seconds[0]):
        lines.append(tr("time {} an episode", tr(" and ").join(times)))
    return "\n".join(line for line in lines if line)


def suggestion_bias_text(s: SuggestionBias) -> str:
    """Return the difference between blind labels and those made with the model visible."""
    lines = [tr("Blind minus shown, {}", count_noun(s.episodes, "episode"))]
    for axis, bias in (("x", s.x_mm), ("y", s.y_mm)):
        said = (
            tr("{}: mean difference {} mm", axis, signed(bias.mean)),
            _limits(bias.lower, bias.upper),
        )
        lines.append(", ".join(filter(None, said)))
    return "\n".join(lines)


def _limits(lower: float, upper: float) -> str:
    limits = tr("95 % limits {} to {}", signed(lower), signed(upper))
    return "" if math.isnan(lower) else limits


def _figure(name: str, value: float, form: str = "{:.2f}") -> str:
    return "" if math.isnan(value) else f"{tr(name)} {form.format(value)}"


class KeyboardLineEdit(QLineEdit):
    """Entry line: Enter takes the text, Esc leaves.

    Other shortcuts are off while it has the focus.
    """

    def __init__(
        self, name: str, hint: str, typed: Callable[[str], None], leave: Callable[[], None]
    ) -> None:
        super().__init__()
        self._typed, self._leave = typed, leave
        self.setAccessibleName(tr(name))
        self.setPlaceholderText(tr(hint))

    def event(self, event: QEvent) -> bool:
        """Claim Enter and Esc before the shortcuts of the page."""
        if event.type() is QEvent.Type.ShortcutOverride and isinstance(event, QKeyEvent):
            enter = (Qt.Key.Key_Return, Qt.Key.Key_Enter, Qt.Key.Key_Escape)
            if event.key() in enter:
                event.accept()
                return True
        return bool(super().event(event))

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Take the text or leave."""
        if event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter):
            self._typed(self.text())
        elif event.key() == Qt.Key.Key_Escape:
            self._leave()
        else:
            super().keyPressEvent(event)


TABS = ("History", "Agreement", "Log", "Bulk", "Health")
HISTORY, BULK, HEALTH = 0, 3, 4


class SideTabs(Panel):
    """Side tabs. ``search`` receives the filter of the log; ``leave`` is called at its end.

    ``tools``: the tabs *Bulk* and *Health*.
    """

    def __init__(
        self,
        theme: Theme,
        restore: Callable[[str], None],
        search: Callable[[str], None],
        entered: Callable[[int], None],
        leave: Callable[[], None],
        tools: tuple[QWidget, QWidget],
    ) -> None:
        super().__init__("")
        self.history = HistoryList(restore)
        self.agreement = label("", wrap=True)
        self.over_time = CurvePlot(theme, "RMS (mm) by period, oldest first")
        self.over_time.hide()
        self.log = QListWidget()
        hint = "Search person, action, episode"
        self.needle = KeyboardLineEdit("Search the log", hint, lambda _: leave(), leave)
        WrappedItemDelegate(self.log)
        self.log.setAccessibleName(tr("Log of all actions"))
        self.needle.textChanged.connect(search)
        self._stack = QStackedWidget()
        log = QWidget()
        vbox(self.needle, (self.log, 1), parent=log, margins=(0, 0, 0, 0))
        agree = _top(self.over_time, self.agreement)
        for page in (self.history, agree, log, *tools):
            self._stack.addWidget(page)
        self.column.addWidget(self._stack, 1)
        self._buttons = QButtonGroup(self)
        for number, name in enumerate(TABS):
            button = push_button(name, role="choice", checkable=True)
            self._buttons.addButton(button, number)
            self.header.insertWidget(number, button)
        self._buttons.idClicked.connect(self.choose)
        self.choose(0)
        self._buttons.idClicked.connect(entered)

    def choose(self, tab: int) -> None:
        """Show one tab."""
        self._stack.setCurrentIndex(tab)
        self._buttons.button(tab).setChecked(True)

    @property
    def tab(self) -> int:
        """Index of the visible tab."""
        return self._stack.currentIndex()

    def show_agreement(self, found: tuple[str, Sequence[CurveLine]]) -> None:
        """Show the figures as text and, over two periods or more, as curves."""
        self.agreement.setText(found[0])
        self.over_time.show_lines(found[1], max((len(one.points) for one in found[1]), default=0))
        self.over_time.setVisible(bool(found[1]))

    def show_log(self, lines: Sequence[str]) -> None:
        """Show operations, newest first."""
        self.log.clear()
        self.log.addItems(list(lines))


def _top(*widgets: QWidget) -> QWidget:
    holder = QWidget()
    vbox(*widgets, 1, parent=holder, margins=(0, 0, 0, 0))
    scroll = scroll_area(holder)
    scroll.setFocusPolicy(Qt.FocusPolicy.NoFocus)
    return scroll


KINDS: tuple[tuple[str, str, str], ...] = (
    ("shift", "Shift the origin", "x,y in mm"),
    ("rotate", "Rotate the frame", "angle in degrees"),
    ("geometry", "Use the present sizes of the pieces", ""),
    ("accept", "Accept", ""),
    ("approve", "Approve", ""),
    ("reject", "Reject", "reason"),
)


class BulkForm(QWidget):
    """Form of a bulk change with a preview and a button that applies it.

    ``entered`` is called on Enter in the line, ``leave`` on Esc.
    """

    def __init__(
        self,
        preview: Callable[[], None],
        apply: Callable[[], None],
        entered: Callable[[], None],
        leave: Callable[[], None],
    ) -> None:
        super().__init__()
        self.kind = QComboBox()
        self.value = KeyboardLineEdit("By how much, or why", "", lambda _: entered(), leave)
        self.kind.setAccessibleName(tr("Change"))
        for name, text, _ in KINDS:
            self.kind.addItem(tr(text), name)
        self.preview, self.apply = push_button("Preview"), push_button("Apply")
        text = "Changes the selected labels (click with Ctrl or Shift), else all of the queue."
        self.found = label(text, "muted", wrap=True)
        buttons = hbox(self.preview, self.apply, 1)
        vbox(
            self.kind, self.value, buttons, self.found, 1,
            parent=self, margins=(0, 0, 0, 0), spacing=5,
        )  # fmt: skip
        self.preview.clicked.connect(preview)
        self.apply.clicked.connect(apply)
        self.kind.currentIndexChanged.connect(self._kind_chosen)
        self.value.textChanged.connect(self._changed)
        self._kind_chosen(0)

    def _kind_chosen(self, at: int) -> None:
        hint = KINDS[at][2]
        self.value.setPlaceholderText(tr(hint))
        self.value.setEnabled(bool(hint))
        self._changed()

    def _changed(self) -> None:
        self.apply.setEnabled(False)
