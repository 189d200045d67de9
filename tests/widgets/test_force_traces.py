"""Each trace has the colour of its axis and lies on its side of zero."""

import numpy as np
import pytest

from tests.widgets.test_views import pixels, shown, theme
from touchdown.widgets.plots.force_traces import TracePlot

__all__ = ["theme"]
LEVELS = {"x": -6.0, "y": 2.0, "z": 8.0}


@pytest.mark.parametrize("theme", ["light"], indirect=True)
def test_more_is_higher_and_each_axis_has_its_colour(qtbot, theme):
    plot = shown(qtbot, TracePlot(theme, "Force", "F", "N", 10.0))
    plot.add(1e-3 * np.arange(5000), np.tile(list(LEVELS.values()), (5000, 1)))
    rect = plot.area().rect
    inside = pixels(plot)[:, int(rect.left()) + 1 : int(rect.right()) - 1]
    zero, unit = rect.center().y(), rect.height() / 20.0
    for axis, level in LEVELS.items():
        hexed = getattr(theme.tokens, f"axis_{axis}")
        want = np.array([int(hexed[i : i + 2], 16) for i in (1, 3, 5)])
        rows = np.flatnonzero((np.abs(inside - want).max(axis=2) < 30).sum(axis=1) > 50)
        assert rows.mean() == pytest.approx(zero - level * unit, abs=1.5), axis
