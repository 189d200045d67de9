"""Form that starts a training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from PySide6.QtCore import QSignalBlocker, Qt, Signal
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QDoubleSpinBox,
    QGridLayout,
    QPushButton,
    QSizePolicy,
    QSpinBox,
    QToolButton,
)

from touchdown.widgets.base import Panel, Theme, add_items, describe, hbox
from touchdown.widgets.forms.fields import (
    draw_run_icons,
    field_label,
    inset_spin_boxes,
    let_shrink,
    select_key,
    set_entries,
)

LABEL_TITLES = (
    ("approved", "Approved labels"),
    ("submitted", "Approved and submitted"),
    ("drafts", "All, with drafts"),
)
LEAST_PX = 72
MODALITIES = (("FT+Tac", "Touch and wrench"), ("Tac", "Touch only"), ("FT", "Wrench only"))


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

    start_requested = Signal()
    cancel_requested = Signal()
    resume_requested = Signal()
    changed = Signal()
    folder_requested = Signal()
    defaults_requested = Signal()

    def __init__(self, theme: Theme) -> None:
        super().__init__("Train")
        self._theme = theme
        # Fixed: in a squeezed form the fields overlap.
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self.data, self.labels, self.piece = QComboBox(), QComboBox(), QComboBox()
        self.modality, self.folder = QComboBox(), QToolButton()
        self.numbers, self.divide = _Numbers(), QCheckBox("Divide series by grips")
        self.start, self.cancel = QPushButton("Start training"), QPushButton("Cancel")
        self.resume, self.defaults = QPushButton("Resume"), QToolButton()
        self.start.setProperty("role", "primary")
        self.defaults.setProperty("role", "plain")
        self.defaults.setText("Defaults")
        self.folder.setText("\N{HORIZONTAL ELLIPSIS}")
        self.folder.setProperty("role", "field")
        set_entries(self.labels, LABEL_TITLES)
        set_entries(self.modality, MODALITIES)
        self._tips()
        self._arrange()
        self.start.clicked.connect(self.start_requested)
        self.cancel.clicked.connect(self.cancel_requested)
        self.resume.clicked.connect(self.resume_requested)
        self.folder.clicked.connect(self.folder_requested)
        self.defaults.clicked.connect(self.defaults_requested)
        for combo in (self.data, self.labels, self.piece, self.modality):
            combo.currentIndexChanged.connect(self.changed)
        for number in self.numbers.all():
            number.valueChanged.connect(self.changed)
        self.divide.toggled.connect(self.changed)
        self.show_buttons(TrainingButtons(start=False, cancel=False, resume=False))

    def _tips(self) -> None:
        describe(
            (self.data, "Data", "A dataset, or a folder of simulated packs"),
            (self.folder, "Choose another folder of data", "Choose another folder of data"),
            (self.labels, "Labels", "Labels to train on"),
            (self.piece, "Piece", "Grasped piece; a model is for one piece"),
            (self.modality, "Sees", "Inputs of the model"),
            (self.start, "Start training", "Train in a separate process (Ctrl+Return)"),
            (self.cancel, "Cancel", "Stop; finished epochs are kept (Esc)"),
            (self.resume, "Resume", "Continue the selected training (Ctrl+Shift+Return)"),
            (self.divide, "Divide series", "Hold out grips instead of whole series (leakage)"),
            (self.defaults, "Defaults", "Fill in the network and settings of the paper"),
        )

    def _arrange(self) -> None:
        form = QGridLayout()
        form.setHorizontalSpacing(10)
        form.setVerticalSpacing(5)
        form.setColumnStretch(1, 1)
        form.setColumnStretch(3, 1)
        form.addWidget(field_label("Data", self.data), 0, 0)
        form.addLayout(hbox((self.data, 1), self.folder, spacing=4), 0, 1, 1, 3)
        rows = (("Labels", self.labels), ("Piece", self.piece), ("Sees", self.modality))
        for row, (text, field) in enumerate(rows, start=1):
            form.addWidget(field_label(text, field), row, 0)
            form.addWidget(field, row, 1, 1, 3)
        self.numbers.place(form, 4)
        self.detail.setText("support: p > 0.9")
        self.detail.setToolTip("A face point above this probability is support (delta)")
        self.header.addWidget(self.defaults)
        # One row, to leave room for the table of the split.
        buttons = hbox((self.start, 1), self.cancel, self.resume, spacing=4)
        add_items(self.column, form, buttons)
        self.folder.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Ignored)
        for one in (self.data, self.labels, self.piece, self.modality):
            one.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
            let_shrink(one)

    def show_data(self, entries: Sequence[tuple[str, str]], chosen: str) -> None:
        """Set the (folder, title) entries and select one, without emitting ``changed``."""
        _refill(self.data, entries, chosen)
        for at, (folder, _) in enumerate(entries):
            self.data.setItemData(at, folder, Qt.ItemDataRole.ToolTipRole)

    def show_pieces(self, entries: Sequence[tuple[str, str]], chosen: str) -> None:
        """Set the (name, title) entries and select one, without emitting ``changed``."""
        _refill(self.piece, entries, chosen)

    def show_form(self, form: TrainingForm) -> None:
        """Fill in the form without emitting ``changed``; unknown entries change nothing."""
        for combo, key in ((self.data, form.data), (self.labels, form.labels),
                           (self.piece, form.piece), (self.modality, form.modality)):  # fmt: skip
            with QSignalBlocker(combo):
                select_key(combo, key)
        self.numbers.show(form)
        with QSignalBlocker(self.divide):
            self.divide.setChecked(form.divide_series)

    def form(self) -> TrainingForm:
        """Return the content of the form."""
        return replace(
            self.numbers.read(),
            data=self.data.currentData() or "",
            labels=self.labels.currentData(),
            piece=self.piece.currentData() or "",
            modality=self.modality.currentData(),
            divide_series=self.divide.isChecked(),
        )

    def show_buttons(self, buttons: TrainingButtons) -> None:
        """Enable buttons and fields; the tool tip of a disabled Start gives the reason."""
        self.start.setEnabled(buttons.start)
        self.start.setToolTip(buttons.why_not or "Train in a separate process (Ctrl+Return)")
        self.cancel.setEnabled(buttons.cancel)
        self.resume.setEnabled(buttons.resume)
        for field in (self.data, self.folder, self.labels, self.piece, self.modality,
                      self.defaults, self.divide, *self.numbers.all()):  # fmt: skip
            field.setEnabled(not buttons.cancel)
        self.draw_icons()

    def draw_icons(self) -> None:
        """Draw the icon in the colours of the theme."""
        draw_run_icons(self._theme, self.start)


class _Numbers:
    """Spin boxes of the form, two per row."""

    def __init__(self) -> None:
        self.layers, self.hidden = _whole(1, 4), _whole(4, 1024)
        self.epochs, self.batch = _whole(1, 1000), _whole(1, 1024)
        self.held_out, self.seed = _whole(5, 50), _whole(0, 999_999)
        self.held_out.setSuffix(" %")
        self.held_out.setProperty("role", "compact")
        self.rate = QDoubleSpinBox()
        self.rate.setDecimals(4)
        self.rate.setRange(0.0001, 1.0)
        self.rate.setSingleStep(0.0005)
        self.named: tuple[tuple[str, str, QSpinBox | QDoubleSpinBox], ...] = (
            ("Layers", "LSTM layers; the paper has 2", self.layers),
            ("Units", "Units of each layer; the paper has 256", self.hidden),
            ("Epochs", "Passes over the training episodes", self.epochs),
            ("Batch", "Episodes per step", self.batch),
            ("Rate", "Learning rate of the optimiser", self.rate),
            ("Seed", "Seed of initial weights, order and split", self.seed),
            ("Held out", "Share of the episodes for validation", self.held_out),
        )
        for name, tip, box in self.named:
            describe((box, name, tip))
            inset_spin_boxes(box)
            box.setMinimumWidth(LEAST_PX)  # two share a row

    def all(self) -> list[QSpinBox | QDoubleSpinBox]:
        return [box for _, _, box in self.named]

    def place(self, form: QGridLayout, first: int) -> None:
        """Place all but the held-out share, which is shown beside the split."""
        for at, (name, _, box) in enumerate(self.named[:-1]):
            row, side = divmod(at, 2)
            form.addWidget(field_label(name, box), first + row, 2 * side)
            form.addWidget(box, first + row, 2 * side + 1)

    def show(self, form: TrainingForm) -> None:
        for box, value in (
            (self.layers, form.layers), (self.hidden, form.hidden), (self.epochs, form.epochs),
            (self.batch, form.batch), (self.held_out, form.held_out), (self.seed, form.seed),
        ):  # fmt: skip
            with QSignalBlocker(box):
                box.setValue(value)
        with QSignalBlocker(self.rate):
            self.rate.setValue(form.learning_rate)

    def read(self) -> TrainingForm:
        return TrainingForm(
            layers=self.layers.value(), hidden=self.hidden.value(), epochs=self.epochs.value(),
            learning_rate=self.rate.value(), batch=self.batch.value(),
            held_out=self.held_out.value(), seed=self.seed.value(),
        )  # fmt: skip


def _whole(low: int, high: int) -> QSpinBox:
    box = QSpinBox()
    box.setRange(low, high)
    box.setKeyboardTracking(False)
    return box


def _refill(combo: QComboBox, entries: Sequence[tuple[str, str]], chosen: str) -> None:
    with QSignalBlocker(combo):
        set_entries(combo, entries)
        combo.setCurrentIndex(max(combo.findData(chosen), 0) if entries else -1)
