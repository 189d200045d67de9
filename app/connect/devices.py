"""Device settings of the connection panel."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from PySide6.QtCore import Qt
from PySide6.QtGui import QShowEvent
from PySide6.QtWidgets import QComboBox, QGridLayout, QHBoxLayout, QLineEdit, QWidget

from touchdown.app.shell import BenchSheet
from touchdown.backend.bench import Session
from touchdown.backend.config import LabSettings, load_lab, save_lab
from touchdown.backend.core import InputError
from touchdown.widgets import base
from touchdown.widgets.forms import field_label


@dataclass(frozen=True, slots=True)
class DeviceField:
    """One value of the lab file: dotted key, device and title.

    ``chosen``: shown as a list of choices; other values can be typed. ``empty``: meaning of an
    empty value. ``beside``: shown in the row of the field before it.
    """

    key: str
    device: str
    title: str
    chosen: bool = False
    empty: str = ""
    beside: bool = False


class DevicesSheet(BenchSheet):
    """Form of the device settings. The presenter interprets the texts."""

    def __init__(self, parent: QWidget, fields: Sequence[DeviceField]) -> None:
        super().__init__(parent, "Devices")
        self.source, self.said = base.label("", wrap=True), base.label("", wrap=True)
        self._form = QWidget()
        self.editors: dict[str, QComboBox | QLineEdit] = {}
        looks = "Look for serial ports and cameras that are plugged in"
        saves = "Write the lab file; nothing is connected or moved"
        opens = "Close the window and open it again on the saved file; asks first"
        self.look = base.push_button("Look again", looks)
        self.save = base.push_button("Save", saves, role="primary")
        self.swap = base.push_button("Exchange left and right", "Each camera to the other finger")
        self.again = base.push_button("Restart program", opens)
        self._arrange(fields)

    def values(self) -> dict[str, str]:
        """Return the texts of the form by key."""
        return {
            key: (editor.currentText() if isinstance(editor, QComboBox) else editor.text()).strip()
            for key, editor in self.editors.items()
        }

    def set_values(self, values: Mapping[str, str]) -> None:
        """Show ``values`` by key."""
        for key, text in values.items():
            editor = self.editors[key]
            if isinstance(editor, QComboBox):
                editor.setCurrentText(text)
            else:
                editor.setText(text)

    def offer(self, choices: Mapping[str, Sequence[str]]) -> None:
        """Show the available choices; entered texts stay."""
        for key, texts in choices.items():
            editor = self.editors.get(key)
            if isinstance(editor, QComboBox):
                kept = editor.currentText()
                editor.clear()
                editor.addItems(list(texts))
                editor.setCurrentText(kept)

    def say(self, text: str, *, bad: bool) -> None:
        """Show the result of the last action."""
        self.said.setText(base.tr(text))
        base.set_property(self.said, "tone", "bad" if bad else "")

    def showEvent(self, event: QShowEvent) -> None:
        """Keep the height of the rows, which a scrolled form would shrink otherwise."""
        super().showEvent(event)
        self._form.setMinimumHeight(self._form.sizeHint().height())

    # -- inside -----------------------------------------------------------------------------------

    def _arrange(self, fields: Sequence[DeviceField]) -> None:
        grid, row, device = QGridLayout(), QHBoxLayout(), ""
        grid.setHorizontalSpacing(16)
        grid.setVerticalSpacing(4)
        grid.setColumnStretch(2, 1)
        for at, one in enumerate(fields):
            editor = self.editors[one.key] = QComboBox() if one.chosen else QLineEdit()
            if isinstance(editor, QComboBox):
                editor.setEditable(True)
                editor.setInsertPolicy(QComboBox.InsertPolicy.NoInsert)
            else:
                editor.setPlaceholderText(base.tr(one.empty))
            editor.setAccessibleName(f"{base.tr(one.device)}: {base.tr(one.title)}")
            if one.beside:
                base.add_items(row, field_label(one.title, editor), (editor, 2))
                continue
            if one.device != device:
                grid.addWidget(base.label(one.device, "title"), at, 0)
            device = one.device
            grid.addWidget(field_label(one.title, editor), at, 1)
            row = base.hbox((editor, 5), spacing=8)
            grid.addLayout(row, at, 2)
        grid.setContentsMargins(0, 0, 8, 0)
        self._form.setLayout(grid)
        scroll = base.scroll_area(self._form)
        scroll.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.arrange(
            base.label("Devices of this bench", "head"), self.source, base.rule(),
            (scroll, 1), self.said, foot=(self.save, self.again, self.look, self.swap), spacing=8,
        )  # fmt: skip
        self.resize_to_em(48, 44)


SOURCE = (
    "Change what differs on your bench, then Save: it is written to {}; other entries stay. "
    "Restart program uses what is saved."
)
LEFT, RIGHT = "gelsight.left.serial", "gelsight.right.serial"
ANY = "any"
FIELDS = (
    DeviceField("ft.driver", "F/T", "Make", chosen=True),
    DeviceField("ft.address", "F/T", "Port or address", chosen=True),
    DeviceField("serials.force_torque", "F/T", "Expected serial", empty=ANY),
    DeviceField(LEFT, "Tactile L", "Serial number", chosen=True),
    DeviceField(RIGHT, "Tactile R", "Serial number", chosen=True),
    DeviceField("wsg.driver", "Gripper", "Make", chosen=True),
    DeviceField("wsg.host", "Gripper", "Address"),
    DeviceField("wsg.port", "Gripper", "Port", beside=True),
    DeviceField("serials.gripper", "Gripper", "Expected serial", empty=ANY),
    DeviceField("melfa.driver", "Arm", "Make", chosen=True),
    DeviceField("melfa.host", "Arm", "Address"),
    DeviceField("melfa.r3.port", "Arm", "Port", beside=True),
    DeviceField("serials.arm", "Arm", "Expected serial", empty=ANY),
)


class DevicesPresenter:
    """Edits the device settings of a bench that has a lab file."""

    def __init__(self, bench: Session, window: QWidget) -> None:
        self._bench, self._window = bench, window
        self._path = Path(bench.limits_source)
        self._settings: LabSettings | None = None
        self._found: Mapping[str, list[str]] = {}
        self.sheet: DevicesSheet | None = None
        self.open_bench: Callable[[Path], None] = lambda file: None

    def open(self) -> None:
        """Show the present content of the file."""
        if self.sheet is None:
            self.sheet = DevicesSheet(self._window, FIELDS)
            self.sheet.look.clicked.connect(self._look)
            self.sheet.swap.clicked.connect(self._swap)
            self.sheet.save.clicked.connect(self._save)
            self.sheet.again.clicked.connect(lambda: self.open_bench(self._path))
            self.sheet.source.setText(base.tr(SOURCE, self._path))
        try:
            self._settings = load_lab(self._path).settings
        except InputError as error:
            self.sheet.say(f"{error.what} {error.fix}", bad=True)
        else:
            self.sheet.set_values({one.key: str(self._held(one.key)) for one in FIELDS})
            self._look()
        self.sheet.present()

    # -- orders -----------------------------------------------------------------------------------

    def _look(self) -> None:
        if self.sheet is None or self._settings is None:
            return
        # Imported here, as nothing else in this process needs the drivers.
        from touchdown.backend.devices import choices

        self._found = found = choices(self._settings)
        self.sheet.offer(found)
        cameras, ports = ", ".join(found[LEFT]), len(found["ft.address"])
        nothing = self._bench.description.mode == "hardware" and not cameras and not ports
        if self._bench.description.mode != "hardware":
            said = base.tr(
                "The devices of this bench are emulated: there is nothing to search for."
            )
        elif nothing:
            said = base.tr(
                "No camera or port was found on USB here. Plug it in, then press Look again."
            )
        else:
            both = cameras or base.tr("none"), ports or base.tr("none")
            said = base.tr("Plugged in: cameras {}; serial ports {}.", *both)
        self.sheet.say(said, bad=False)
        base.set_property(self.sheet.look, "role", "primary" if nothing else "")
        base.set_property(self.sheet.save, "role", "" if nothing else "primary")

    def _swap(self) -> None:
        if self.sheet is not None:
            values = self.sheet.values()
            self.sheet.set_values({LEFT: values[RIGHT], RIGHT: values[LEFT]})

    def _save(self) -> None:
        if self.sheet is None or self._settings is None:
            return
        texts, values = self.sheet.values(), dict[str, str | int]()
        for one in FIELDS:
            text, held = texts[one.key], self._held(one.key)
            if text == str(held):
                continue
            wrong = self._wrong(one, text)
            if wrong:
                self.sheet.say(wrong, bad=True)
                return
            values[one.key] = int(text) if isinstance(held, int) else text
        if texts[LEFT] == texts[RIGHT] != "":
            self.sheet.say("Both fingers have the same camera.", bad=True)
            return
        self._write(self.sheet, values)

    def _wrong(self, one: DeviceField, text: str) -> str:
        """Return why ``text`` is not valid for a field, "" if it is."""
        if isinstance(self._held(one.key), int) and not text.isdecimal():
            return base.tr(
                "{}, {}: write a number.", base.tr(one.device), base.tr(one.title).lower()
            )
        if one.key.endswith(".driver") and text not in self._found[one.key]:
            drivers = ", ".join(self._found[one.key])
            return base.tr("There is no '{}' here: use one of {}.", text, drivers)
        return ""

    def _write(self, sheet: DevicesSheet, values: dict[str, str | int]) -> None:
        try:
            save_lab(self._path, values)
            self._settings = load_lab(self._path).settings
        except InputError as error:
            sheet.say(f"{error.what} {error.fix}", bad=True)
        except OSError as error:
            sheet.say(base.tr("The file cannot be written: {}.", error.strerror), bad=True)
        else:
            sheet.say("Saved. Restart to use it." if values else "Nothing is changed.", bad=False)
            base.set_property(sheet.again, "role", "primary" if values else "")
            base.set_property(sheet.save, "role", "" if values else "primary")

    def _held(self, key: str) -> object:
        value: object = self._settings
        for part in key.split("."):
            value = getattr(value, part)
        return value
