"""Presenter of the device inspector: a click on a chip opens what the device says of itself."""

from __future__ import annotations

from functools import partial

from PySide6.QtCore import QPoint
from PySide6.QtWidgets import QWidget

from app.link import Link
from backend.devices.protocols import Device
from widgets.device_inspector import DeviceInspector
from widgets.top_bar import CHIPS, TopBar


class InspectPresenter:
    """Keeps one inspector; it follows the device that was clicked last."""

    def __init__(self, link: Link, bar: TopBar, window: QWidget) -> None:
        self._link, self._bar, self._window = link, bar, window
        self._titles = dict(CHIPS)
        self.sheet: DeviceInspector | None = None
        for key, chip in bar.chips.items():
            chip.clicked.connect(partial(self.open, key))

    def open(self, key: str) -> None:
        """Show the inspector of a device below its chip."""
        device = self._link.devices.get(key)
        if device is None:
            return
        if self.sheet is None:
            self.sheet = DeviceInspector(self._window)
        chip = self._bar.chips[key]
        below = chip.mapToGlobal(QPoint(0, chip.height() + 8))
        self.sheet.open_at(key, self._titles[key], rows_of(device), below)

    def draw(self) -> None:
        """Show the present values while it is open."""
        if self.sheet is None or not self.sheet.isVisible():
            return
        device = self._link.devices.get(self.sheet.key)
        if device is not None:
            self.sheet.show_rows(rows_of(device))


def rows_of(device: Device) -> list[tuple[str, str]]:
    """Return connection, health, identity and the device's own fields as (field, value)."""
    health, who = device.health, device.identity
    rows = [
        ("state", device.state.value),
        ("rate (Hz)", f"{health.rate_hz:.1f}"),
        ("age (ms)", f"{1e3 * max(health.age_s, 0.0):.0f}"),
        ("received", f"{health.received}"),
        ("lost", f"{health.lost}"),
    ]
    if who is not None:
        rows += [("maker", who.maker), ("model", who.model), ("serial", who.serial),
                 ("firmware", who.firmware)]  # fmt: skip
    for field, value in device.describe().items():
        text = value if isinstance(value, str) else f"{value:g}"
        rows.append((field, text.replace("-", "\N{MINUS SIGN}") if text != value else text))
    return rows
