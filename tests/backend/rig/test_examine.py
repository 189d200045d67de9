"""A look at the devices of a lab: who answers is named, who does not has a fix, nothing moves."""

import pytest

from touchdown.backend.bench.emulator_registry import emulate
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.devices.melfa.driver import MelfaArm
from touchdown.backend.emulation.serving import EmulationChoice
from touchdown.backend.rig import diagnostics as looking
from touchdown.backend.rig.diagnostics import examine_devices


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(looking, "LIMIT_S", 0.3)
    monkeypatch.setattr(looking, "LISTEN_S", 0.05)


def test_each_device_is_asked_and_the_arm_stays_off(short, tmp_path):
    served = [emulate(EmulationChoice(kind, port=None)) for kind in ("dynpick", "wsg", "melfa")]
    tables = {}
    for one in served:
        one.start()
        for name, table in one.bench.items():
            first, _, second = name.partition(".")
            place = tables.setdefault(first, {})
            (place.setdefault(second, {}) if second else place).update(table)
    tables["gelsight"] = {"by_id": str(tmp_path), "names": str(tmp_path), "nodes": str(tmp_path)}
    try:
        found = {f.device: f for f in examine_devices(HardwareSettings.model_validate(tables))}
        controller = served[2].fronts[0]._device.controller
        assert not controller.servo
    finally:
        for one in served:
            one.close()
    assert [f.ok for f in found.values()] == [True, False, False, True, True]
    assert "Dynpick" in found["force_torque"].detail
    assert "12345" in found["gripper"].detail
    assert found["arm"].detail.endswith("not switched on")
    assert "No camera with the number" in found["tactile_left"].detail
    assert found["tactile_left"].fix


def test_an_arm_that_is_away_says_what_to_check(short):
    settings = HardwareSettings.model_validate(
        {"melfa": {"host": "127.0.0.1", "r3": {"port": 9, "stop_port": 9}},
         "ft": {"driver": "dynpick", "address": "socket://127.0.0.1:9"},
         "wsg": {"host": "127.0.0.1", "port": 9}},
    )  # fmt: skip
    found = list(examine_devices(settings))
    assert not any(f.ok for f in found)
    assert all(f.fix for f in found)
    assert "cable" in found[-1].fix
    assert MelfaArm.name == found[-1].device
