"""What the window shows of a wrist sensor that drifts: read-out, chip, inspector, card."""

import pytest

from tests.app.conftest import settle
from touchdown.backend.core.events import Noticed
from touchdown.backend.runs.calibrations import drift_notice
from touchdown.backend.sensing.zeroing import WrenchDrift


def look(live, bench):
    """Draw what is drawn now and then."""
    bench.turn(0.2)
    live._chips._drawn_s = live.workspaces["operate"].live._headers_s = float("-inf")
    settle(live)


@pytest.mark.promise("S8")
def test_a_little_drift_is_a_figure_and_much_is_yellow_and_named(live, bench):
    live.go("operate")
    look(live, bench)
    plot, chip = live.workspaces["operate"].page.force, live.bar.chips["force_torque"]
    assert "drift" not in plot.summary()
    bench.drift = WrenchDrift(0.12, 240.0)
    look(live, bench)
    assert plot.summary().endswith("; drift 0.12 N in 4 min")
    assert chip.value.state == "ready"
    assert chip.value.tip.endswith("drift 0.12 N in 4 min, in still air")
    bench.drift = much = WrenchDrift(0.52, 11.0, named=True)
    bench.events.publish(Noticed(bench.clock_s(), drift_notice(much)))
    look(live, bench)
    assert (chip.value.state, chip.value.detail) == ("degraded", "drift 0.52 N")
    assert live.cards.codes == ("FT-DRIFT",)
    card = live.cards.card("FT-DRIFT").text
    assert "drifted by 0.52 N in 11 s" in card.what
    assert (card.notice, card.reset) == (True, False), "it stops nothing"
    live.inspect.open("force_torque")
    assert live.inspect.sheet.rows()["drift in air"] == "0.52 N in 11 s"
    live.inspect.open("gripper")
    assert "drift in air" not in live.inspect.sheet.rows()
