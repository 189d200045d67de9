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
    QHBoxLayout,
    QPushButton,
    QSizePolicy,
    QSpinBox,
    QToolButton,
    QWidget,
)

from touchdown.widgets.base import Panel, Theme, fit_icon, icon, label
from touchdown.widgets.forms.fields import inset_spin_boxes

LABELS = (
    ("approved", "Approved labels"),
    ("submitted", "Also submitted ones"),
    ("drafts", "Also the bench's own notes"),
)
LEAST_PX = 72
MODALITIES = (("FT+Tac", "Touch and wrench"), ("Tac", "Touch only"), ("FT", "Wrench only"))


@dataclass(frozen=True, slots=True)
class TrainingForm:
    """What is filled in. ``held_out``: share of the episodes for validation, in per cent.

    ``divide_series``: whole grips of a series may be held out, where there are few mountings.
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
    """Which buttons may be pressed; ``why_not`` says why Start may not."""

    start: bool
    cancel: bool
    resume: bool
    why_not: str = ""


class TrainingFormPanel(Panel):
    """The form and its buttons."""

    start_requested = Signal()
    cancel_requested = Signal()
    resume_requested = Signal()
    changed = Signal()
    folder_requested = Signal()
    defaults_requested = Signal()

    def __init__(self, theme: Theme) -> None:
        super().__init__("Train")
        self._theme = theme
        # A form that is squeezed has fields over one another.
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
        for combo, entries in ((self.labels, LABELS), (self.modality, MODALITIES)):
            for key, text in entries:
                combo.addItem(text, key)
        self._tips()
        self._arrange()
        self._connect()
        self.show_buttons(TrainingButtons(start=False, cancel=False, resume=False))

    def _connect(self) -> None:
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

    def _tips(self) -> None:
        for widget, name, tip in (
            (self.data, "Data", "A dataset, or a folder of simulated packs"),
            (self.folder, "Choose another folder of data", "Choose another folder of data"),
            (self.labels, "Labels", "Which labels of a dataset count"),
            (self.piece, "Piece", "The grasped piece; a model knows one"),
            (self.modality, "Sees", "What the model sees of a probe"),
            (self.start, "Start training", "Train in a process of its own (Ctrl+Return)"),
            (self.cancel, "Cancel", "Stop; whole epochs are kept (Esc)"),
            (self.resume, "Resume", "Go on with the chosen unfinished run (Ctrl+Shift+Return)"),
            (self.divide, "Divide series", "Hold out grips of a series that is trained on: leaks"),
            (self.defaults, "Defaults", "Fill in the paper's network and the usual training"),
        ):
            widget.setAccessibleName(name)
            widget.setToolTip(tip)

    def _arrange(self) -> None:
        form = QGridLayout()
        form.setHorizontalSpacing(10)
        form.setVerticalSpacing(5)
        form.setColumnStretch(1, 1)
        form.setColumnStretch(3, 1)
        where = QHBoxLayout()
        where.setSpacing(4)
        where.addWidget(self.data, 1)
        where.addWidget(self.folder)
        form.addWidget(_buddy("Data", self.data), 0, 0)
        form.addLayout(where, 0, 1, 1, 3)
        rows = (("Labels", self.labels), ("Piece", self.piece), ("Sees", self.modality))
        for row, (text, field) in enumerate(rows, start=1):
            form.addWidget(_buddy(text, field), row, 0)
            form.addWidget(field, row, 1, 1, 3)
        self.numbers.place(form, 4)
        self.detail.setText("support: p > 0.9")
        self.detail.setToolTip("A face point supports above this probability (the paper's delta)")
        self.header.addWidget(self.defaults)
        # One row: the table of the split needs the room of a second.
        buttons = QHBoxLayout()
        buttons.setSpacing(4)
        buttons.addWidget(self.start, 1)
        buttons.addWidget(self.cancel)
        buttons.addWidget(self.resume)
        self.column.addLayout(form)
        self.column.addLayout(buttons)
        # As high as the field beside it.
        self.folder.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Ignored)
        for one in (self.data, self.labels, self.piece, self.modality):
            one.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
            one.setMinimumContentsLength(8)
            one.setSizeAdjustPolicy(
                QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon
            )

    def show_data(self, entries: Sequence[tuple[str, str]], chosen: str) -> None:
        """Offer these (folder, title) and choose one, without telling; the tip has the folder."""
        _refill(self.data, entries, chosen)
        for at, (folder, _) in enumerate(entries):
            self.data.setItemData(at, folder, Qt.ItemDataRole.ToolTipRole)

    def show_pieces(self, entries: Sequence[tuple[str, str]], chosen: str) -> None:
        """Offer these (name, title) and choose one, without telling."""
        _refill(self.piece, entries, chosen)

    def show_form(self, form: TrainingForm) -> None:
        """Fill in a form without telling; unknown entries are left as they are."""
        for combo, key in ((self.data, form.data), (self.labels, form.labels),
                           (self.piece, form.piece), (self.modality, form.modality)):  # fmt: skip
            with QSignalBlocker(combo):
                index = combo.findData(key)
                if index >= 0:
                    combo.setCurrentIndex(index)
        self.numbers.show(form)
        with QSignalBlocker(self.divide):
            self.divide.setChecked(form.divide_series)

    def form(self) -> TrainingForm:
        """Return what is filled in."""
        return replace(
            self.numbers.read(),
            data=self.data.currentData() or "",
            labels=self.labels.currentData(),
            piece=self.piece.currentData() or "",
            modality=self.modality.currentData(),
            divide_series=self.divide.isChecked(),
        )

    def show_buttons(self, buttons: TrainingButtons) -> None:
        """Enable what is allowed now; a disabled Start says why."""
        self.start.setEnabled(buttons.start)
        self.start.setToolTip(buttons.why_not or "Train in a process of its own (Ctrl+Return)")
        self.cancel.setEnabled(buttons.cancel)
        self.resume.setEnabled(buttons.resume)
        for field in (self.data, self.folder, self.labels, self.piece, self.modality,
                      self.defaults, self.divide, *self.numbers.all()):  # fmt: skip
            field.setEnabled(not buttons.cancel)
        self.draw_icons()

    def draw_icons(self) -> None:
        """Draw the icon in the colours of the theme."""
        t = self._theme.tokens
        ink = t.colour("panel") if self.start.isEnabled() else t.colour("disabled")
        self.start.setIcon(icon("play", ink))
        fit_icon(self.start)


class _Numbers:
    """The spin boxes of the form, two a row."""

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
            ("Batch", "Episodes a step", self.batch),
            ("Rate", "Learning rate of the optimiser", self.rate),
            ("Seed", "Of first weights, order and split", self.seed),
            ("Held out", "Share of the episodes that validation keeps", self.held_out),
        )
        for name, tip, box in self.named:
            box.setAccessibleName(name)
            box.setToolTip(tip)
            inset_spin_boxes(box)
            # Two share a row: the room of the largest number would not fit.
            box.setMinimumWidth(LEAST_PX)

    def all(self) -> list[QSpinBox | QDoubleSpinBox]:
        return [box for _, _, box in self.named]

    def place(self, form: QGridLayout, first: int) -> None:
        """Place all but the share held out, which stands beside the split."""
        for at, (name, _, box) in enumerate(self.named[:-1]):
            row, side = divmod(at, 2)
            form.addWidget(_buddy(name, box), first + row, 2 * side)
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
        combo.clear()
        for key, title in entries:
            combo.addItem(title, key)
        combo.setCurrentIndex(max(combo.findData(chosen), 0) if entries else -1)


def _buddy(text: str, field: QWidget) -> QWidget:
    made = label(text, "muted")
    made.setBuddy(field)
    return made
