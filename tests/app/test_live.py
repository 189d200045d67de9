"""What of the wrench goes into which plot."""

from types import SimpleNamespace

import numpy as np

from touchdown.app.shell.live import LivePresenter, LiveViews
from touchdown.backend.core.streams import SampleStream


class NotedPlot:
    """Keeps what it is told to draw."""

    def __init__(self):
        self.t_s, self.values, self.span_s = [], [], 10.0

    def isVisible(self):  # noqa: N802
        return True

    def add(self, t_s, values):
        self.t_s.append(t_s)
        self.values.append(values)

    def show_span(self, span_s):
        self.span_s = span_s

    def show_age(self, age, age_s, reason):
        pass


def test_forces_and_moments_go_into_their_own_plots_axis_by_axis():
    wrench = SampleStream("wrench", 6, 100)
    t_s = 0.001 * np.arange(3)
    values = np.array([1.0, -2.0, 8.0, 0.1, -0.2, 0.3]) + 0.01 * np.arange(3)[:, None]
    wrench.put(t_s, values)
    force, moment = NotedPlot(), NotedPlot()
    live = LivePresenter(
        SimpleNamespace(wrench=wrench), LiveViews({}, {}, force, moment), lambda: 0.1
    )
    live.draw_wrench()
    np.testing.assert_array_equal(force.values, [values[:, :3]])
    np.testing.assert_array_equal(moment.values, [values[:, 3:]])
    np.testing.assert_array_equal(force.t_s, [t_s])
    np.testing.assert_array_equal(moment.t_s, [t_s])
    live.draw_wrench()
    assert len(force.values) == 1, "nothing new came"
    live.show_span(30.0)
    assert (force.span_s, moment.span_s) == (30.0, 30.0)
    np.testing.assert_array_equal(force.values[1], values[:, :3])
    np.testing.assert_array_equal(moment.values[1], values[:, 3:])
