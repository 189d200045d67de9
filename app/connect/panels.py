"""The panels of one bench: its limits, and its connection where the operator makes it."""

from __future__ import annotations

from PySide6.QtWidgets import QWidget

from app.calibrate.presenter import CalibratePresenter
from app.connect.limits import LimitsPresenter
from app.connect.presenter import ConnectPresenter
from app.link import Link
from widgets.fault_cards import FaultCards
from widgets.theme import Theme


class BenchPanels:
    """Made with the bench; devices that are connected by hand are asked for at once."""

    def __init__(self, link: Link, theme: Theme, window: QWidget, cards: FaultCards) -> None:
        self.calibrate = CalibratePresenter(link, theme, window, cards)
        self.limits = LimitsPresenter(link, window, cards)
        self.connect: ConnectPresenter | None = None
        if link.connection is not None:
            self.connect = ConnectPresenter(link, link.connection, window, cards, self.limits)

    def open_connect(self) -> bool:
        """Show the Connect panel, or connect, or cancel; False where there is none."""
        if self.connect is None:
            return False
        self.connect.open()
        return True

    def draw(self) -> None:
        """Follow the bench."""
        self.calibrate.draw()
        if self.connect is not None:
            self.connect.draw()
