"""Presenter of the device wizard: what a lab file says of its devices, and what is in sight."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from PySide6.QtWidgets import QWidget

from app.connect.devices_sheet import DeviceField, DeviceIntents, DevicesSheet
from app.link import Link
from backend.config.lab import LabSettings, load_lab
from backend.config.lab_edit import save_lab
from backend.core.faults import InputError

LEFT, RIGHT = "gelsight.left.serial", "gelsight.right.serial"
ANY = "any"
FIELDS = (
    DeviceField("ft.driver", "F/T", "Make", chosen=True),
    DeviceField("ft.address", "F/T", "Port or address", chosen=True),
    DeviceField("serials.force_torque", "F/T", "Number that must answer", empty=ANY),
    DeviceField(LEFT, "Tactile L", "Number on the sensor", chosen=True),
    DeviceField(RIGHT, "Tactile R", "Number on the sensor", chosen=True),
    DeviceField("wsg.driver", "Gripper", "Make", chosen=True),
    DeviceField("wsg.host", "Gripper", "Address"),
    DeviceField("wsg.port", "Gripper", "Port"),
    DeviceField("serials.gripper", "Gripper", "Number that must answer", empty=ANY),
    DeviceField("melfa.driver", "Arm", "Make", chosen=True),
    DeviceField("melfa.host", "Arm", "Address"),
    DeviceField("melfa.r3.port", "Arm", "Port of the commands"),
    DeviceField("serials.arm", "Arm", "Number that must answer", empty=ANY),
)


class DevicesPresenter:
    """Keeps one form; made where the bench comes from a lab file."""

    def __init__(self, link: Link, window: QWidget) -> None:
        self._path, self._window = Path(link.limits_source), window
        self._settings: LabSettings | None = None
        self._found: Mapping[str, list[str]] = {}
        self.sheet: DevicesSheet | None = None

    def open(self) -> None:
        """Show what the file says now."""
        if self.sheet is None:
            intents = DeviceIntents(self._look, self._swap, self._save)
            self.sheet = DevicesSheet(self._window, FIELDS, intents)
            self.sheet.source.setText(f"In {self._path}. What else it says stays as it is.")
        try:
            self._settings = load_lab(self._path).settings
        except InputError as error:
            self.sheet.say(f"{error.what} {error.fix}", bad=True)
        else:
            self.sheet.set_values({one.key: str(self._held(one.key)) for one in FIELDS})
            self._look()
        self.sheet.show()
        self.sheet.raise_()

    # -- orders -----------------------------------------------------------------------------------

    def _look(self) -> None:
        if self.sheet is None or self._settings is None:
            return
        # The drivers are needed by nobody else in this process: only who chooses waits for them.
        from backend.devices.found import choices

        self._found = found = choices(self._settings)
        self.sheet.offer(found)
        cameras, ports = ", ".join(found[LEFT]), len(found["ft.address"])
        self.sheet.say(
            f"In sight: cameras {cameras or 'none'}; serial ports {ports or 'none'}.", bad=False
        )

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
        """Return why ``text`` cannot stand there; "" if the file may say it."""
        if isinstance(self._held(one.key), int) and not text.isdecimal():
            return f"{one.device}, {one.title.lower()}: write a number."
        if one.key.endswith(".driver") and text not in self._found[one.key]:
            return f"There is no '{text}' here: use one of {', '.join(self._found[one.key])}."
        return ""

    def _write(self, sheet: DevicesSheet, values: dict[str, str | int]) -> None:
        try:
            save_lab(self._path, values)
            self._settings = load_lab(self._path).settings
        except InputError as error:
            sheet.say(f"{error.what} {error.fix}", bad=True)
        except OSError as error:
            sheet.say(f"The file cannot be written: {error.strerror}.", bad=True)
        else:
            again = "It holds when the window is opened again with this file."
            sheet.say(f"Saved. {again}" if values else "Nothing is changed.", bad=False)

    def _held(self, key: str) -> object:
        value: object = self._settings
        for part in key.split("."):
            value = getattr(value, part)
        return value
