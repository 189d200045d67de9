"""Text from outside is shown as it is written: no label takes markup (reliability D9)."""

import pytest
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QLabel

from tests.app.conftest import settle


@pytest.mark.promise("D9")
def test_every_label_shows_text_and_no_markup(live, bench):
    for page in ("operate", "collect", "train", "stack", "review"):
        live.go(page)
        settle(live)
    labels = live.window.findChildren(QLabel)
    assert len(labels) > 100
    # A picture has no text; any other label would guess.
    marked = [one for one in labels if one.textFormat() != Qt.TextFormat.PlainText]
    assert [one.text() for one in marked if one.text()] == []
