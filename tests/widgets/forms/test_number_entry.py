"""A number that a field cannot hold is refused, never changed into another one."""

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QDoubleSpinBox, QSpinBox, QToolTip

from touchdown.widgets.base import Theme
from touchdown.widgets.forms.fields import inset_spin_boxes
from touchdown.widgets.forms.probe import ProbePanel


def test_the_buttons_of_a_probe_follow_every_change(qtbot):
    panel = ProbePanel(Theme(), ("grip", "press"))
    qtbot.addWidget(panel)
    for probe, cancel, why in (
        (False, False, "Press Reset first"),
        (True, False, ""),
        (True, False, ""),
        (False, True, ""),
        (False, True, "A run is going on"),
    ):
        panel.show_buttons(probe=probe, cancel=cancel, why=why)
        assert (panel.probe.isEnabled(), panel.cancel.isEnabled()) == (probe, cancel)
        assert panel.probe.toolTip().startswith(why or "Press here")


@pytest.fixture
def box(qtbot, request):
    made = request.param()
    made.setRange(-20, 20)
    made.setValue(5)
    made.setSuffix(" mm")
    qtbot.addWidget(made)
    inset_spin_boxes(made)
    made.show()
    return made


@pytest.mark.parametrize("box", [QSpinBox, QDoubleSpinBox], indirect=True)
@pytest.mark.parametrize("typed", ["-5e9", "1e99", "21", "-20.4", "5x", "nan", ""])
def test_what_a_field_cannot_hold_is_refused_with_the_allowed_range(box, typed):
    box.selectAll()
    QTest.keyClicks(box, typed)
    if not typed:
        QTest.keyClick(box, Qt.Key.Key_Delete)
        QTest.keyClicks(box, " ")
    assert box.value() == 5, "also before the entry ends: F5 starts a run without that"
    QTest.keyClick(box, Qt.Key.Key_Return)
    assert (box.value(), box.text().removesuffix(".00 mm").removesuffix(" mm")) == (5, "5")
    assert box.property("refused") == "yes"
    QApplication.processEvents()
    assert "20" in QToolTip.text()
    assert "mm is allowed" in QToolTip.text()
    QTest.keyClick(box, Qt.Key.Key_Up)
    assert (box.value(), box.property("refused")) == (6, "no")
    box.selectAll()
    QTest.keyClicks(box, "-7")
    assert box.property("refused") == "no"
    QTest.keyClick(box, Qt.Key.Key_Return)
    assert (box.value(), box.property("refused")) == (-7, "no")


@pytest.mark.parametrize("box", [QDoubleSpinBox], indirect=True)
def test_a_number_with_more_decimals_than_shown_is_refused_or_kept_never_another(box):
    box.selectAll()
    QTest.keyClicks(box, "7.25")
    QTest.keyClick(box, Qt.Key.Key_Return)
    assert (box.value(), box.property("refused")) == (7.25, "no")
