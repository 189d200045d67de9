"""Fonts and icons are made once per program: with each font Qt forgets what it measured of all."""

from PySide6.QtCore import QDir
from PySide6.QtGui import QColor, QFontDatabase

from touchdown.widgets.base.theme import load_resources, pixmap


def test_a_second_window_registers_nothing_again(qapp):
    load_resources()
    load_resources()
    assert len(QDir.searchPaths("icons")) == 1
    assert "Inter" in QFontDatabase.families()


def test_an_icon_is_drawn_once_per_colour_and_size(qapp):
    ink, other = QColor("#123456"), QColor("#654321")
    drawn = pixmap("stop", ink, 24)
    assert pixmap("stop", ink, 24).cacheKey() == drawn.cacheKey()
    assert drawn.toImage() != pixmap("stop", other, 24).toImage()
    assert pixmap("stop", ink, 30).width() == 30
