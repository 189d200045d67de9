"""A chip per device: what one of them suffers is said on its own chip alone."""

from dataclasses import replace

import pytest

from tests.app.conftest import settle
from touchdown.backend.devices.protocols import Health, SafetyMode


def pass_s(live, bench, seconds):
    """Let time pass by the bench's own clock, and show it."""
    for _ in range(round(seconds / 0.1)):
        bench.turn(0.1)
        settle(live, 4)


def states(live):
    return {name: chip.value.state for name, chip in live.bar.chips.items()}


@pytest.mark.promise("W6")
def test_a_device_that_drops_out_changes_only_its_own_chip(live, bench):
    live._chips._now_s = bench.clock_s
    live._chips._drawn_s = float("-inf")
    pass_s(live, bench, 0.6)
    assert set(states(live)) == set(bench.devices)
    assert set(states(live).values()) == {"ready"}
    for lost, (name, device) in enumerate(bench.devices.items(), start=5):
        bench.silent.add(name)
        device.received, device.lost = 20, lost
        pass_s(live, bench, 0.8)
        assert {n for n, state in states(live).items() if state != "ready"} == {name}
        assert states(live)[name] == "stale"
        shown = {n: chip.value.lost for n, chip in live.bar.chips.items()}
        assert shown == {n: lost if n == name else 0 for n in shown}
        assert f"{lost} " in live.bar.chips[name].toolTip()
        bench.silent.clear()
        device.received, device.lost = 5000, 0
        pass_s(live, bench, 0.6)
        assert set(states(live).values()) == {"ready"}, "it comes back by itself"


def test_a_device_without_a_sample_has_no_age_yet(live, bench, monkeypatch):
    silent = Health(0.0, float("inf"), 0, 0)
    monkeypatch.setattr(type(bench.devices["arm"]), "health", silent)
    live._chips._drawn_s = float("-inf")
    settle(live)
    assert "no data yet" in live.bar.chips["arm"].value.detail


@pytest.mark.parametrize(
    ("simulated", "safety", "told"),
    [
        (True, SafetyMode.NORMAL, "none"),
        (False, SafetyMode.NORMAL, "unknown"),
        (False, SafetyMode.HW_STOP, "active"),
    ],
)
def test_a_hardware_emergency_stop_is_told_as_far_as_it_is_known(
    live, bench, monkeypatch, simulated, safety, told
):
    arm = bench.devices["arm"]
    status = replace(arm.status(), safety_mode=safety)
    monkeypatch.setattr(type(arm), "status", lambda _: status)
    monkeypatch.setattr(bench, "simulated", simulated)
    live._chips._drawn_s = float("-inf")
    settle(live)
    assert live.bar._estop.text() == told
