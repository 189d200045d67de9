"""The bar gives up figures, then a row, before it gives up STOP or a name."""

import pytest
from PySide6.QtCore import QRect
from PySide6.QtWidgets import QApplication

from touchdown.widgets.base.panel import ElidedLabel
from touchdown.widgets.base.theme import Theme, load_resources
from touchdown.widgets.shell.top_bar import TopBar


@pytest.fixture
def bar(qapp, qtbot):
    """A bar at a font scale and width."""
    load_resources()
    theme = Theme()
    made = []

    def build(scale, width):
        theme.apply(qapp, "dark", scale)
        bar = TopBar(theme, lambda: None)
        qtbot.addWidget(bar)
        bar.show_modes("Moving", "Normal")
        bar.show_hardware_stop("none")
        bar.resize(width, bar.sizeHint().height())
        bar.show()
        qtbot.waitExposed(bar, timeout=60_000)
        bar.fit()
        bar.resize(width, bar.sizeHint().height())
        QApplication.processEvents()
        made.append(bar)
        return bar

    yield build
    theme.apply(qapp, "dark", 1.0)


def places(bar):
    parts = [bar.pill, bar.stop, *bar.chips.values(), bar.override, bar.servo]
    return [QRect(p.mapTo(bar, p.rect().topLeft()), p.size()) for p in parts]


@pytest.mark.parametrize("scale", [1.0, 1.2, 1.5, 2.0])
@pytest.mark.parametrize("width", [1280, 1600, 1920])
def test_nothing_is_cut_and_nothing_overlaps(bar, scale, width):
    bar = bar(scale, width)
    assert bar.minimumSizeHint().width() <= width
    areas = places(bar)
    for k, area in enumerate(areas):
        assert bar.rect().contains(area)
        assert not any(area.intersects(other) for other in areas[k + 1 :])
    for part in (bar.stop, bar.servo, *bar.chips.values()):
        assert part.width() >= part.sizeHint().width()


def test_little_room_first_costs_the_figures_then_a_second_row(bar):
    chip = "tactile_left"
    assert not bar(1.0, 1600).chips[chip].short
    assert not bar(1.0, 1280).chips[chip].short
    assert bar(1.0, 1100).chips[chip].short
    tightest = bar(2.0, 1280)
    assert not tightest.chips[chip].short
    assert tightest.chips[chip].geometry().height() * 2 < tightest.height()
    tightest.resize(3000, 120)
    QApplication.processEvents()
    row = {p.center().y() for p in places(tightest)[2:-2]} | {places(tightest)[0].center().y()}
    assert max(row) - min(row) <= 2


def test_a_cut_line_ends_in_an_ellipsis(qtbot):
    label = ElidedLabel("small")
    qtbot.addWidget(label)
    label.setText("Probe 1: contact on 28 % of the face")
    label.resize(90, 20)
    assert label.shown().endswith("\N{HORIZONTAL ELLIPSIS}")
    assert label.fontMetrics().horizontalAdvance(label.shown()) <= 90
    label.resize(900, 20)
    assert label.shown() == label.text()
    assert label.minimumSizeHint().width() == 0
