"""Scores of a run and of compared strategies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QComboBox, QDialog, QSizePolicy, QSpinBox, QWidget

from touchdown.backend.core import Outcome
from touchdown.widgets import base
from touchdown.widgets.forms import field_label, inset_spin_boxes, set_entries
from touchdown.widgets.views.belief import BeliefScene, BeliefView

MOST_VOID = 3
LEAST_TRIALS = 3  # the interval of fewer spans nearly everything
HEAD_PX = 260  # least width of a text beside controls
OUTCOME_WORDS: dict[Outcome, str] = {
    Outcome.PLACED: "placed",
    Outcome.FELL: "fell",
    Outcome.KNOCKED_OVER: "knocked over",
    Outcome.GAVE_UP: "gave up",
    Outcome.ASKED: "asked",
    Outcome.ABORTED: "aborted",
}


@dataclass(frozen=True, slots=True)
class Score:
    """Outcomes so far, planned trials, and the Wilson interval of the success rate (0..1).

    ``excused``: number of aborted trials left out of the rate; ``last`` gives the reason. ``void``:
    one line per void trial.
    """

    outcomes: tuple[Outcome, ...]
    trials: int
    interval: tuple[float, float] | None
    last: str = ""
    excused: int = 0
    void: tuple[str, ...] = ()

    @property
    def counted(self) -> int:
        """Number of trials in the rate."""
        return len(self.outcomes) - self.excused


class OutcomeMarks(QWidget):
    """One mark per trial: tick, cross, dash, or a hollow box for trials to come."""

    def __init__(self, theme: base.Theme) -> None:
        super().__init__()
        self._theme = theme
        self._outcomes: Sequence[Outcome] = ()
        self._trials = 0
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def show_outcomes(self, outcomes: Sequence[Outcome], trials: int) -> None:
        """Show the outcomes and the trials to come."""
        self._outcomes, self._trials = outcomes, max(trials, len(outcomes))
        self.setAccessibleName(
            ", ".join(base.tr(OUTCOME_WORDS[o]) for o in outcomes)
            if outcomes
            else base.tr("No trial finished")
        )
        self.update()

    def sizeHint(self) -> QSize:
        """Return one row of marks."""
        return QSize(200, 24)

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the marks that fit, the newest last."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        room = max(int(self.width() // 22), 1)
        first = max(0, min(len(self._outcomes) - room + 1, self._trials - room))
        for place, index in enumerate(range(first, min(first + room, self._trials))):
            at = QPointF(11 + 22 * place, self.height() / 2)
            outcome = self._outcomes[index] if index < len(self._outcomes) else None
            _mark(painter, self._theme, at, outcome)


def _mark(painter: QPainter, theme: base.Theme, at: QPointF, outcome: Outcome | None) -> None:
    t = theme.tokens
    painter.setPen(QPen(t.colour("border"), 1))
    painter.setBrush(Qt.BrushStyle.NoBrush)
    box = QRectF(at.x() - 9, at.y() - 9, 18, 18)
    if outcome is None:
        painter.drawRoundedRect(box, 4, 4)
        return
    good = outcome is Outcome.PLACED
    fallen = outcome in (Outcome.FELL, Outcome.KNOCKED_OVER)
    painter.setBrush(t.colour("pill_green" if good else "pill_red" if fallen else "pill_grey"))
    painter.drawRoundedRect(box, 4, 4)
    painter.setPen(QPen(t.colour("on_light" if good else "on_dark"), 2))
    if good:
        painter.drawPolyline([at + QPointF(-4.5, 0.5), at + QPointF(-1, 4), at + QPointF(5, -4)])
    elif fallen:
        painter.drawLine(at + QPointF(-4, -4), at + QPointF(4, 4))
        painter.drawLine(at + QPointF(-4, 4), at + QPointF(4, -4))
    else:
        painter.drawLine(at + QPointF(-4, 0), at + QPointF(4, 0))


class ScorePanel(base.Panel):
    """Count of placed pieces, success rate with its 95 % interval, and marks."""

    def __init__(self, theme: base.Theme, title: str = "Trials") -> None:
        super().__init__(title)
        self._count = base.label("0 of 0 placed", "figure")
        self._rate = base.label("", "small", wrap=True)
        self._marks = OutcomeMarks(theme)
        self._last = base.label("", "small", wrap=True)
        self._void = base.label("", "small", wrap=True)
        self._void.hide()
        base.add_items(self.column, self._count, self._marks, self._rate, self._last, self._void, 1)
        self.show_score(Score((), 0, None))

    def show_score(self, score: Score) -> None:
        """Show the score."""
        placed = sum(o is Outcome.PLACED for o in score.outcomes)
        none = base.tr("No trial finished yet" if score.trials else "No trial yet")
        self._count.setText(
            base.tr("{} of {} placed", placed, score.counted) if score.outcomes else none
        )
        # Before the first outcome the result beside it is the only headline.
        base.set_property(self._count, "role", "figure" if score.outcomes else "title")
        done = base.tr("{} of {}", len(score.outcomes), score.trials) if score.trials else ""
        aborted = sum(o is Outcome.ABORTED for o in score.outcomes)
        # Short: it shares the header with a button.
        last = base.tr("{}, {} aborted", done, aborted) if aborted else base.tr("{} done", done)
        self.detail.setText(last if done else "")
        rate = success_rate_text(score)
        self._rate.setText(rate)
        self._rate.setVisible(bool(rate))
        self._marks.show()
        self._marks.show_outcomes(score.outcomes, score.trials)
        self._last.setText(score.last or base.tr("One mark per finished trial."))
        # The newest only: a long run would fill the page.
        self._void.setText("\n".join(score.void[-MOST_VOID:]))
        self._void.setToolTip("\n".join(score.void))
        self._void.setVisible(bool(score.void))

    @property
    def words(self) -> str:
        """Shown texts, line by line."""
        shown = (self._count, self._rate, self._last, self._void)
        return "\n".join(one.text() for one in shown if one.text() and not one.isHidden())

    def show_facts(self, headline: str, text: str) -> None:
        """Describe a recording without trials: a headline and a small text."""
        self._count.setText(headline)
        base.set_property(self._count, "role", "figure")
        self.detail.setText("")
        self._marks.hide()
        self._rate.hide()
        self._void.hide()
        self._last.setText(text)


def success_rate_text(score: Score) -> str:
    """Return the success rate with its interval, "" before ``LEAST_TRIALS`` counted trials."""
    if score.interval is None or score.counted < LEAST_TRIALS:
        return ""
    low, high = (100 * bound for bound in score.interval)
    share = 100 * sum(o is Outcome.PLACED for o in score.outcomes) / score.counted
    return base.tr("{:.0f} % success, 95 % interval {:.0f} to {:.0f} %", share, low, high)


@dataclass(frozen=True, slots=True)
class StrategyResult:
    """Result of one strategy. ``count``: placed of tried; ``rate``: success with its interval;
    ``trial``: outcome of the selected trial, as texts.
    """

    title: str
    outcomes: tuple[Outcome, ...] = ()
    trials: int = 0
    count: str = "Not run yet"
    rate: str = ""
    trial: str = ""
    good: bool | None = None
    scene: BeliefScene = field(default_factory=BeliefScene)


class StrategyPanel(base.Panel):
    """Column of one strategy in the comparison."""

    def __init__(self, theme: base.Theme) -> None:
        super().__init__("")
        self.count, self.marks = base.label("", "figure"), OutcomeMarks(theme)
        self.rate = base.label("", "small", wrap=True)
        self.trial = base.label("", wrap=True)
        self.belief = BeliefView(theme)
        base.add_items(self.column, self.count, self.marks, self.rate, self.trial, (self.belief, 1))

    def show_look(self, look: StrategyResult) -> None:
        """Show the result of a strategy."""
        self.rename(look.title)
        self.count.setText(base.tr(look.count))
        self.rate.setText(look.rate)
        self.rate.setVisible(bool(look.rate))
        self.marks.show_outcomes(look.outcomes, look.trials)
        self.trial.setText(look.trial)
        base.set_property(self.trial, "tone", {True: "good", False: "bad", None: ""}[look.good])
        if self.belief.scene is not look.scene:
            self.belief.show_scene(look.scene)


class ComparisonSheet(QDialog):
    """Non-modal comparison of two strategies on the same seeds.

    ``run`` starts the missing run; ``choose`` gets the selected trial (from 1); ``against`` gets
    the strategy of the right side.
    """

    def __init__(
        self,
        parent: QWidget,
        theme: base.Theme,
        run: Callable[[], None],
        choose: Callable[[int], None],
        against: Callable[[str], None],
    ) -> None:
        super().__init__(parent)
        self._window = parent
        self.setWindowTitle(base.tr("Strategies on the same seed"))
        self.head = base.label("", "head", wrap=True)
        self._pairs = base.label("", "muted", wrap=True)
        self.panels = StrategyPanel(theme), StrategyPanel(theme)
        self.trial = QSpinBox()
        self.trial.setRange(1, 1)
        inset_spin_boxes(self.trial)
        base.describe((self.trial, "Trial", "Trial shown on both sides"))
        self.trial.valueChanged.connect(choose)
        self.against = QComboBox()
        base.describe((self.against, "Strategy to compare with", "Strategy on the right"))
        self.against.activated.connect(lambda at: against(self.against.itemData(at)))
        self.run = base.push_button("Run both", role="primary")
        self.run.setAutoDefault(False)
        self.run.clicked.connect(run)
        self._arrange()

    def _arrange(self) -> None:
        close = base.push_button("Close")
        close.clicked.connect(self.close)
        top = base.FlowLayout(
            (self.head, HEAD_PX), field_label("Against", self.against), self.against,
            field_label("Trial", self.trial), self.trial,
        )  # fmt: skip
        columns = QWidget()
        panels = ((panel, 1) for panel in self.panels)
        base.hbox(*panels, parent=columns, margins=(0, 0, 0, 0), spacing=8)
        scroll = base.scroll_area(columns)
        scroll.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        foot = base.FlowLayout((self._pairs, HEAD_PX), close, self.run)
        base.vbox(top, (scroll, 1), foot, parent=self, margins=(14, 12, 14, 12), spacing=8)

    def offer(self, rivals: Sequence[tuple[str, str]], chosen: str) -> None:
        """Set the (key, title) strategies for the right side and select one."""
        set_entries(self.against, rivals, chosen)

    def show_pairs(self, text: str) -> None:
        """Show what the trials on equal seeds decide."""
        self._pairs.setText(text)

    def open_large(self) -> None:
        """Show the sheet over most of its window."""
        base.open_over(self, self._window, (1040, 640), 120)

    def show_run(self, text: str, why_not: str) -> None:
        """Set label and availability of the run button; "" as ``text`` hides it."""
        self.run.setVisible(bool(text))
        self.run.setText(base.tr(text))
        self.run.setEnabled(not why_not)
        self.run.setToolTip(why_not or base.tr("One after the other, with the same seed"))
