"""Form that starts a training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from PySide6.QtCore import QSignalBlocker, Qt, Signal
from PySide6.QtWidgets import QCheckBox, QComboBox, QSizePolicy, QToolButton

from touchdown.widgets.base import Panel, Theme, add_items, describe, hbox, label, push_button, tr
from touchdown.widgets.forms.fields import (
    FormFields,
    decimal_box,
    draw_run_icons,
    field_label,
    set_entries,
    whole_box,
)

LABEL_TITLES = (
    ("approved", "Approved labels"),
    ("submitted", "Approved and submitted"),
    ("drafts", "All, with drafts"),
)
LEAST_PX = 72
MODALITIES = (("FT+Tac", "Touch + wrench"), ("Tac", "Touch only"), ("FT", "Wrench only"))


@dataclass(frozen=True, slots=True)
class TrainingForm:
    """Settings of a training. ``held_out``: share of the episodes for validation, per cent.

    ``divide_series``: hold out grips instead of whole series, where there are few mountings.
    """

    data: str = ""
    labels: str = "approved"
    piece: str = ""
    modality: str = "FT+Tac"
    layers: int = 2
    hidden: int = 256
    learning_rate: float = 1e-3
    epochs: int = 16
    batch: int = 64
    held_out: int = 10
    seed: int = 0
    divide_series: bool = False


@dataclass(frozen=True, slots=True)
class TrainingButtons:
    """Enabled buttons; ``why_not``: reason for a disabled Start."""

    start: bool
    cancel: bool
    resume: bool
    why_not: str = ""


class TrainingFormPanel(Panel):
    """Form of a training with its buttons."""

    changed = Signal()

    def __init__(self, theme: Theme) -> None:
        super().__init__("Next training")
        self._theme = theme
        # Fixed: in a squeezed form the fields overlap.
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self.data, self.labels, self.piece = QComboBox(), QComboBox(), QComboBox()
        self.modality, self.folder = QComboBox(), QToolButton()
        self.divide = QCheckBox(tr("Divide series by grips"))
        self.layers, self.hidden = whole_box(1, 4), whole_box(4, 1024)
        self.epochs, self.batch = whole_box(1, 1000), whole_box(1, 1024)
        self.held_out, self.seed = whole_box(5, 50), whole_box(0, 999_999)
        self.held_out.setSuffix(" %")
        self.held_out.setProperty("role", "compact")
        self.rate = decimal_box(0.0001, 1.0, decimals=4, step=0.0005)
        numbers = (self.layers, self.hidden, self.epochs, self.batch, self.held_out, self.seed)
        self._fields = FormFields(
            10, 5, data=self.data, labels=self.labels, piece=self.piece, modality=self.modality,
            layers=self.layers, hidden=self.hidden, epochs=self.epochs, batch=self.batch,
            learning_rate=self.rate, seed=self.seed, held_out=self.held_out,
            divide_series=self.divide,
        )  # fmt: skip
        self.start = push_button("Start training", role="primary")
        self.cancel, self.resume = push_button("Cancel"), push_button("Resume")
        self.defaults = QToolButton()
        self.why_not = label("", wrap=True)
        self.defaults.setProperty("role", "plain")
        self.defaults.setText(tr("Defaults"))
        self.folder.setText("\N{HORIZONTAL ELLIPSIS}")
        self.folder.setProperty("role", "field")
        set_entries(self.labels, LABEL_TITLES)
        set_entries(self.modality, MODALITIES)
        describe(
            (self.data, "Data", "A dataset, or a folder of simulated packs"),
            (self.folder, "Choose another folder of data", "Choose another folder of data"),
            (self.start, "Start training", "Train in a separate process (Ctrl+Return)"),
            (self.cancel, "Cancel", "Stop; finished epochs are kept (Esc)"),
            (self.resume, "Resume", "Continue the selected training (Ctrl+Shift+Return)"),
            (self.divide, "Divide series", "Hold out grips instead of whole series (leakage)"),
            (self.defaults, "Defaults", "Fill in the network and settings of the paper"),
            (self.held_out, "Held out", "Share of the episodes for validation"),
        )
        self._arrange()
        for combo in (self.data, self.labels, self.piece, self.modality):
            combo.currentIndexChanged.connect(self.changed)
        for number in (*numbers, self.rate):
            number.setMinimumWidth(LEAST_PX)  # two share a row
            number.valueChanged.connect(self.changed)
        for number in numbers:
            number.setKeyboardTracking(False)
        self.divide.toggled.connect(self.changed)
        self.show_buttons(TrainingButtons(start=False, cancel=False, resume=False))

    def _arrange(self) -> None:
        fields = self._fields
        fields.addWidget(field_label("Data", self.data), 0, 0)
        fields.addLayout(hbox((self.data, 1), self.folder, spacing=4), 0, 1, 1, 3)
        fields.add_wide(
            1,
            ("Labels", self.labels, "Labels to train on"),
            ("Piece", self.piece, "Grasped piece; a model is for one piece"),
            ("Sees", self.modality, "Inputs of the model"),
        )
        # The held-out share stands beside the split.
        fields.add_halves(
            4,
            ("Layers", self.layers, "LSTM layers; the paper has 2"),
            ("Units", self.hidden, "Units of each layer; the paper has 256"),
            ("Epochs", self.epochs, "Passes over the training episodes"),
            ("Batch", self.batch, "Episodes per step"),
            ("Rate", self.rate, "Learning rate of the optimiser"),
            ("Seed", self.seed, "Seed of initial weights, order and split"),
        )
        self.detail.setText(tr("Support above 90 %"))
        tip = "A point of the face is support if its probability of contact is above 90 % (delta)"
        self.detail.setToolTip(tr(tip))
        self.header.addWidget(self.defaults)
        # One row, to leave room for the table of the split.
        buttons = hbox((self.start, 1), self.cancel, self.resume, spacing=4)
        add_items(self.column, fields, buttons, self.why_not)
        self.folder.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Ignored)

    def show_data(self, entries: Sequence[tuple[str, str]], chosen: str) -> None:
        """Set the (folder, title) entries and select one, without emitting ``changed``."""
        with QSignalBlocker(self.data):
            set_entries(self.data, entries, chosen)
        for at, (folder, _) in enumerate(entries):
            self.data.setItemData(at, folder, Qt.ItemDataRole.ToolTipRole)

    def show_pieces(self, entries: Sequence[tuple[str, str]], chosen: str) -> None:
        """Set the (name, title) entries and select one, without emitting ``changed``."""
        with QSignalBlocker(self.piece):
            set_entries(self.piece, entries, chosen)
            self.piece.setPlaceholderText(tr("none with labels yet"))

    def show_form(self, form: TrainingForm) -> None:
        """Fill in the form without emitting ``changed``; unknown entries change nothing."""
        with QSignalBlocker(self):
            self._fields.fill(form)

    def form(self) -> TrainingForm:
        """Return the content of the form."""
        return TrainingForm(**self._fields.read())

    def show_buttons(self, buttons: TrainingButtons) -> None:
        """Enable buttons and fields; the reason for a disabled Start is written below it."""
        self.start.setEnabled(buttons.start)
        self.why_not.setText(buttons.why_not)
        self.why_not.setVisible(bool(buttons.why_not))
        self.cancel.setEnabled(buttons.cancel)
        self.resume.setEnabled(buttons.resume)
        self._fields.set_enabled(not buttons.cancel)
        self.folder.setEnabled(not buttons.cancel)
        self.defaults.setEnabled(not buttons.cancel)
        self.fit_to_theme()

    def fit_to_theme(self) -> None:
        """Draw the icon in the colours of the theme."""
        draw_run_icons(self._theme, self.start)
