"""Form that starts a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtCore import Signal
from PySide6.QtWidgets import QCheckBox, QComboBox

from touchdown.widgets import base
from touchdown.widgets.forms.fields import (
    FormFields,
    decimal_box,
    draw_run_icons,
    let_shrink,
    set_entries,
    whole_box,
)

STRATEGIES = (
    ("paper", "Probe and believe"),
    ("paper-calibrated", "Probe and believe, calibrated"),
    ("fused", "Learned fusion"),
    ("fused-any", "Learned fusion, any outline"),
    ("fused-certified", "Learned fusion, certified risk"),
    ("fused-uneven", "Learned fusion, uneven bottoms"),
    ("fused-wrench", "Learned fusion, wrench alone"),
    ("zero-wrench", "Release at zero wrench"),
    ("pick-and-place", "Pick and place"),
)
MODES = (
    ("auto", "Auto: asks if unsure"),
    ("approve", "Approve each move"),
    ("step", "Step by step"),
)


@dataclass(frozen=True, slots=True)
class RunForm:
    """Settings of a run. ``under``: body below the bottom, "" for none.

    ``origin_x_mm``, ``origin_y_mm``: centre of the bottom in arm coordinates, for real devices.
    ``weigh``: measure the centre of mass first. ``staged``: open the jaws in held steps.
    """

    piece: str = "pot"
    bottom: str = "short"
    under: str = ""
    seed: int = 7
    trials: int = 3
    strategy: str = "paper"
    mode: str = "auto"
    weigh: bool = False
    staged: bool = False
    origin_x_mm: float = 0.0
    origin_y_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class RunButtons:
    """Enabled buttons; ``paused``: the run is paused; ``form``: the form is editable."""

    start: bool
    pause: bool
    cancel: bool
    paused: bool
    form: bool
    why_not: str = ""


class RunPanel(base.Panel):
    """Form and buttons of a run; ``chosen`` is emitted on another piece, bottom, strategy or
    release.
    """

    chosen = Signal()

    def __init__(self, theme: base.Theme) -> None:
        super().__init__("Run")
        self._theme = theme
        self._piece, self._bottom, self._under = QComboBox(), QComboBox(), QComboBox()
        self._seed, self._trials = whole_box(0, 999_999), whole_box(1, 100)
        self._origin = decimal_box(-300.0, 300.0), decimal_box(-300.0, 300.0)
        self._strategy, self._mode = QComboBox(), QComboBox()
        self._weigh = QCheckBox(base.tr("Weigh first"))
        self._staged = QCheckBox(base.tr("Open in stages"))
        self._fields = FormFields(
            12, 6, piece=self._piece, bottom=self._bottom, under=self._under, seed=self._seed,
            trials=self._trials, strategy=self._strategy, mode=self._mode, weigh=self._weigh,
            staged=self._staged, origin_x_mm=self._origin[0], origin_y_mm=self._origin[1],
        )  # fmt: skip
        self._model = base.ElidedLabel("small")
        self._certificate = base.label("", "small", wrap=True)
        self._certificate.setAccessibleName(base.tr("Certificate"))
        self._signals = base.label("", "small", wrap=True)
        set_entries(self._strategy, STRATEGIES)
        set_entries(self._mode, MODES)
        self.start = base.push_button("Start stacking", role="primary")
        self.pause, self.cancel = base.push_button("Pause"), base.push_button("Cancel")
        self.row = base.flat_button("In a row", "List of planned runs (Ctrl+Shift+D)")
        for combo in (self._piece, self._bottom, self._under, self._strategy):
            combo.currentIndexChanged.connect(lambda _: self.chosen.emit())
        self._staged.toggled.connect(lambda _: self.chosen.emit())
        base.describe(
            (self.pause, "Pause", "Pause at the next safe point, arm lifted (P)"),
            (self.cancel, "Cancel", "End the run: lift the arm, keep the grip"),
        )
        self.start.setAccessibleName(base.tr("Start stacking"))
        self._arrange()
        self.show_buttons(RunButtons(False, False, cancel=False, paused=False, form=True))

    def _arrange(self) -> None:
        fields = self._fields
        fields.add_wide(
            0,
            ("Piece", self._piece, "Piece in the gripper; its geometry is known"),
            ("Bottom", self._bottom, "Body to stack on; its shape is unknown to the method"),
            ("Stands on", self._under, "Table, or a second body under the bottom, for a tower"),
        )
        fields.add_halves(
            3,
            ("Seed", self._seed, "Trial k uses seed + k; the same seed gives the same run"),
            ("Trials", self._trials, "Number of trials"),
        )
        fields.add_wide(
            4,
            ("Strategy", self._strategy, "The paper's method, learned fusion, or no probing"),
            ("Model", self._model, ""),
            ("Mode", self._mode, "Moves that wait for your approval"),
        )
        tip = ("Measure the centre of mass of the held piece in six poses, and judge by it; "
               "for pieces of 100 g or more")  # fmt: skip
        stages = ("Release in held steps of 0.1 mm, about 40 s, and close the jaws if the piece "
                  "begins to turn; for heavy pieces")  # fmt: skip
        base.describe((self._staged, "Open in stages", stages), (self._weigh, "Weigh first", tip))
        fields.addLayout(base.hbox((self._staged, 1), (self._weigh, 1)), 7, 1, 1, 3)
        x, y = self._origin
        self._origin_words = fields.add_halves(8, ("Origin x", x, ""), ("y", y, "", "Origin y"))
        self.show_devices(False)
        self.column.addLayout(fields)
        base.add_items(self.column, self._certificate, self._signals)
        self.column.addSpacing(2)
        self.header.addWidget(self.row)
        self.column.addLayout(base.hbox((self.start, 2), (self.pause, 1), (self.cancel, 1)))

    def show_catalogue(
        self, pieces: Sequence[tuple[str, str]], bottoms: Sequence[tuple[str, str]]
    ) -> None:
        """Set the (key, title) pieces and bottoms; the selection is kept if possible."""
        form = self.form()
        for combo, entries in ((self._piece, pieces), (self._bottom, bottoms),
                               (self._under, (("", "the table"), *bottoms))):  # fmt: skip
            set_entries(combo, entries)
        self.show_form(form)

    def show_model(self, short: str, full: str) -> None:
        """Show the model in use; the tool tip has the details."""
        self._model.setText(base.tr(short))
        self._model.setToolTip(base.tr(full))
        self._model.setAccessibleName(base.tr("Model: {}", short))

    def show_certificate(self, text: str, scope: str) -> None:
        """Show what is known about the risk of a release; the tool tip has its scope.

        "" hides the line.
        """
        self._certificate.setText(text)
        self._certificate.setVisible(bool(text))
        self._certificate.setToolTip(scope)
        self._certificate.setAccessibleDescription(f"{text} {scope}")

    def show_options(self, *, weigh: bool, stages: bool) -> None:
        """Offer to weigh a piece that is heavy enough, and stages where the release is tested."""
        for box, possible in ((self._weigh, weigh), (self._staged, stages)):
            box.setVisible(possible)
            box.setChecked(box.isChecked() and possible)

    def show_signals(self, text: str) -> None:
        """Show how the signals compare with their calibration; "" hides the line."""
        self._signals.setText(text)
        self._signals.setVisible(bool(text))

    def show_devices(self, devices: bool) -> None:
        """Show the origin fields, needed by real devices only."""
        for widget in (*self._origin, *self._origin_words):
            widget.setVisible(devices)

    def show_form(self, form: RunForm) -> None:
        """Fill in the form; unknown entries change nothing."""
        self._fields.fill(form)

    def form(self) -> RunForm:
        """Return the content of the form."""
        return RunForm(**self._fields.read())

    def show_buttons(self, buttons: RunButtons) -> None:
        """Enable buttons and fields; the tool tip of a disabled Start gives the reason."""
        self.start.setEnabled(buttons.start)
        self.start.setToolTip(buttons.why_not or base.tr("Start the run (Ctrl+Return)"))
        self.pause.setEnabled(buttons.pause)
        self.pause.setText(base.tr("Resume" if buttons.paused else "Pause"))
        self.cancel.setEnabled(buttons.cancel)
        self._fields.set_enabled(buttons.form and self._piece.count() > 0)
        self.fit_to_theme()

    def fit_to_theme(self) -> None:
        """Draw the icons in the colours of the theme."""
        draw_run_icons(self._theme, self.start, self.pause, self.cancel)


Entries = Sequence[tuple[str, str]]  # (name, title) of pieces


class ScenePanel(base.Panel):
    """Sets piece and bottom of the simulated bench; ``on_set`` gets their names."""

    def __init__(self, on_set: Callable[[str, str], None]) -> None:
        super().__init__("Bench")
        self._on_set = on_set
        self.piece, self.bottom = QComboBox(), QComboBox()
        self.set = base.push_button("Set")
        base.describe(
            (self.piece, "Piece", "Piece between the jaws"),
            (self.bottom, "Bottom", "Body below the piece"),
            (
                self.set,
                "Set the bench",
                "Reset both to their places on the simulated bench (Ctrl+N)",
            ),
        )
        let_shrink(self.piece, self.bottom, letters=6)
        self.set.clicked.connect(self.ask)
        self.column.addLayout(base.hbox((self.piece, 1), (self.bottom, 1), self.set))

    def show_catalogue(self, pieces: Entries, bottoms: Entries, chosen: tuple[str, str]) -> None:
        """Set the entries and select ``chosen`` (piece, bottom)."""
        set_entries(self.piece, pieces, chosen[0])
        set_entries(self.bottom, bottoms, chosen[1])

    def show_ready(self, ready: bool) -> None:
        """Enable or disable the controls."""
        for widget in (self.piece, self.bottom, self.set):
            widget.setEnabled(ready)

    def ask(self) -> None:
        """Call ``on_set`` with the selection."""
        piece, bottom = self.piece.currentData(), self.bottom.currentData()
        if piece and bottom:
            self._on_set(str(piece), str(bottom))
