"""Form that starts a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from PySide6.QtCore import QSignalBlocker, Signal
from PySide6.QtWidgets import QCheckBox, QComboBox, QProgressBar, QSizePolicy

from touchdown.widgets.base import Panel, Theme, add_items, describe, hbox, label, push_button, tr
from touchdown.widgets.forms.fields import (
    FormFields,
    decimal_box,
    draw_run_icons,
    set_entries,
    whole_box,
)
from touchdown.widgets.forms.questions import NameField

PATTERNS = (
    ("random", "Random, as in the paper"),
    ("grid", "Grid"),
    ("adaptive", "Adaptive: fill the gaps"),
    ("rest", "Identify: at rest"),
    ("gel", "Identify: arm and gel"),
    ("contact", "Identify: slip"),
    ("drag", "Identify: drag"),
)
WIDEST_MM = 60.0
NO_LIMIT = "any"


@dataclass(frozen=True, slots=True)
class TargetForm:
    """Settings of a campaign. ``within_mm`` 0: any displacement with enough overlap.

    ``probes_per_grip`` 0: automatic, so that the campaign has three grips or more; at most 50.
    ``seed`` 0: a new one for each campaign. ``pattern``: of the displacements, or a recording plan.
    """

    piece: str = "pot"
    bottom: str = "circle15"
    within_mm: float = 0.0
    pattern: str = "random"
    count: int = 20
    probes_per_grip: int = 0
    seed: int = 0
    origin_x_mm: float = 0.0
    origin_y_mm: float = 0.0
    check_origin: bool = False
    ask: bool = True
    hand_over: bool = False


@dataclass(frozen=True, slots=True)
class TargetButtons:
    """Enabled buttons. ``go_on``: what the last campaign still lacks, "" if nothing.

    ``why_not``: reason why nothing can be started. ``in_contact``: a lift would help. ``ask``: text
    to confirm or, with ``answers`` (yes, no), a question of the run. ``form``: the form is
    editable.
    """

    start: bool
    pause: bool
    end: bool
    paused: bool
    go_on: str = ""
    why_not: str = ""
    in_contact: bool = False
    ask: str = ""
    answers: tuple[str, str] | None = None
    form: bool = True


class TargetPanel(Panel):
    """Form of a campaign with its buttons and progress."""

    pair_chosen = Signal()

    def __init__(self, theme: Theme) -> None:
        super().__init__("Target")
        self._theme = theme
        self.piece, self.bottom, self.pattern = QComboBox(), QComboBox(), QComboBox()
        self.within, self.count = decimal_box(0.0, WIDEST_MM), whole_box(1, 100_000)
        self.within.setSpecialValueText(tr(NO_LIMIT))
        self.within.setSuffix(" mm")
        self.per_grip, self.seed = whole_box(0, 1000, "auto"), whole_box(0, 999_999, "new")
        self.person = NameField()
        self.origin = decimal_box(-100.0, 100.0, step=0.1), decimal_box(-100.0, 100.0, step=0.1)
        self.check_origin = QCheckBox(tr("Touch the edges after every mounting"))
        self.ask = QCheckBox(tr("Wait for an answer after each probe"))
        self.hand_over = QCheckBox(tr("Hand the piece over (no jig)"))
        self.residual = label("", "small", wrap=True)
        self.here, self.take = push_button("Set here"), push_button("Correct origin")
        self.why_not = label("", "small", wrap=True)
        self.lift = push_button("Lift 5 mm", role="header")
        self.start = push_button("Start collecting", role="primary")
        self.go_on, self.pause, self.end = map(push_button, ("Continue", "Pause", "End"))
        self.bar, self.eta = QProgressBar(), label("", "small")
        self._fields = FormFields(
            8, 3, piece=self.piece, bottom=self.bottom, within_mm=self.within,
            pattern=self.pattern, count=self.count, probes_per_grip=self.per_grip, seed=self.seed,
            origin_x_mm=self.origin[0], origin_y_mm=self.origin[1],
            check_origin=self.check_origin, ask=self.ask, hand_over=self.hand_over,
        )  # fmt: skip
        set_entries(self.pattern, PATTERNS)
        self.bar.setFormat(tr("This series: %v of %m"))
        self.person.setMaxLength(64)
        describe(
            (self.check_origin, "Check the origin", "Touch all four edges with the held piece"),
            (self.ask, "Ask after every probe", "The arm waits until you press a key"),
            (self.hand_over, "Hand over", "You hold the piece between the jaws and take it back"),
            (
                self.here,
                "Set the origin where the arm is",
                "Jog the arm over the centre of the bottom first",
            ),
            (self.take, "Correct the origin", "Add the residual of the last check to the origin"),
            (self.lift, "Lift", "Lift by 5 mm; no campaign can start in contact"),
            (self.end, "End the campaign for now", "Lift, store the finished probes, end"),
            (self.bar, "Progress", "Accepted probes of the campaign"),
        )
        self._arrange()
        for combo in (self.piece, self.bottom):
            combo.currentIndexChanged.connect(self.pair_chosen)
        self.show_form(TargetForm())
        self.show_residual("Origin as entered; checking it is optional.", usable=False)
        self.show_buttons(TargetButtons(start=False, pause=False, end=False, paused=False))
        self.show_progress(0, 0, "")

    def _arrange(self) -> None:
        # Compact: at the smallest window size a campaign in contact shows every row.
        self.column.setSpacing(4)
        fields = self._fields
        fields.add_wide(
            0,
            ("Piece", self.piece, "Piece to grasp, in its jig"),
            ("Bottom", self.bottom, "Body to press on; its outline is known", "Bottom or board"),
            ("Pattern", self.pattern, "Pattern of the displacements, or a recording for Identify"),
            ("Person", self.person, "Your name; stored with every episode"),
        )
        x, y = self.origin
        per_grip = "The piece is gripped anew after so many probes; auto: at least three grips"
        seed = "new: another plan each time; the same seed gives the same plan"
        within, within_tip = "Range \N{PLUS-MINUS SIGN}", "Largest displacement along x and along y"
        fields.add_halves(
            4,
            (within, self.within, within_tip, "Range"),
            ("Probes", self.count, "Number of probes to plan"),
            ("Regrip", self.per_grip, per_grip, "Probes per grip"),
            ("Seed", self.seed, seed),
            ("Origin x", x, "Centre of the bottom in arm coordinates, x (mm)"),
            ("y", y, "Centre of the bottom in arm coordinates, y (mm)", "Origin y"),
        )
        self.person.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        add_items(
            self.column, fields, hbox((self.here, 3), (self.take, 2)),
            self.residual, self.check_origin, self.hand_over, self.ask, self.start,
            hbox((self.why_not, 1), self.lift),
            hbox((self.go_on, 1), (self.pause, 1), (self.end, 1)), self.bar, self.eta, 1,
        )  # fmt: skip

    def show_catalogue(
        self, pieces: Sequence[tuple[str, str]], bottoms: Sequence[tuple[str, str]]
    ) -> None:
        """Set the (key, title) pieces and bottoms; the selection is kept if possible."""
        form = self.form()
        for combo, entries in ((self.piece, pieces), (self.bottom, bottoms)):
            with QSignalBlocker(combo):
                set_entries(combo, entries)
        self.show_form(form)

    def show_form(self, form: TargetForm) -> None:
        """Fill in the form; unknown entries change nothing."""
        self._form = form
        self._fields.fill(form)

    def form(self) -> TargetForm:
        """Return the content of the form; without a catalogue, the pair shown last."""
        return replace(self._form, **self._fields.read())

    def show_buttons(self, buttons: TargetButtons) -> None:
        """Enable buttons and fields; Start confirms while ``ask`` is set."""
        self.start.setEnabled(buttons.start or bool(buttons.ask))
        yes, no = buttons.answers or ("Confirm", "Continue")
        self.start.setText(tr(yes if buttons.ask else "Start collecting"))
        said = buttons.ask or (f"{buttons.why_not}." if buttons.why_not else "")
        self.why_not.setText(said)
        self.why_not.setVisible(bool(said))
        there = "Yes (F5)" if buttons.answers else "Confirm (F5)"
        tip = tr(there if buttons.ask else "Start a new campaign (F5)")
        self.start.setToolTip(buttons.why_not or tip)
        self.lift.setVisible(buttons.in_contact)
        self.go_on.setText(tr(no))
        asked = buttons.answers is not None
        self.go_on.setEnabled(asked or (buttons.start and bool(buttons.go_on)))
        tip = buttons.go_on or tr("No campaign to continue")
        self.go_on.setToolTip(tr("No (Shift+F5)") if asked else tip)
        self.pause.setEnabled(buttons.pause)
        self.pause.setText(tr("Resume" if buttons.paused else "Pause"))
        self.pause.setToolTip(tr("Pause at the next safe point, arm lifted (P)"))
        self.end.setEnabled(buttons.end)
        self._fields.set_enabled(buttons.form)
        self.person.setEnabled(buttons.form)
        self.here.setEnabled(buttons.form)
        self.fit_to_theme()

    def ask_person(self) -> None:
        """Focus the name field."""
        self.person.setFocus()
        self.person.selectAll()

    def show_progress(self, done: int, total: int, eta: str) -> None:
        """Show the progress; ``eta`` is a text."""
        self.bar.setRange(0, max(total, 1))
        self.bar.setValue(min(done, total))
        self.bar.setVisible(total > 0)
        self.eta.setText(eta)
        self.eta.setVisible(bool(eta))

    def show_residual(self, text: str, *, usable: bool) -> None:
        """Show the result of the last check of the origin."""
        self.residual.setText(tr(text))
        self.take.setEnabled(usable)

    def fit_to_theme(self) -> None:
        """Draw the icons in the colours of the theme."""
        draw_run_icons(self._theme, self.start, self.pause, self.end)
