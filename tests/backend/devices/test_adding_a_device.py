"""The toy wrist sensor of docs/adding-a-device.md works as the page says."""

import ast
import re
import sys
import threading
import time
import tomllib
from pathlib import Path

import pytest

from tests.backend.devices import test_force_torque_contract as contract
from touchdown.backend import devices
from touchdown.backend.bench.emulator_registry import bench_toml, emulate
from touchdown.backend.cli.command_line import main
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices import choices, make_force_torque, registry
from touchdown.backend.emulation import EmulationChoice, add_noise

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "adding-a-device.md").read_text("utf-8")
FILES = dict(re.findall(r"^`(\w+\.py)`:\n\n```py\n(.*?)```", PAGE, re.DOTALL | re.MULTILINE))
(LINE,) = re.findall(r"```py\n(Make\(.*?\)),\n```", PAGE, re.DOTALL)


@pytest.fixture(autouse=True)
def toy(tmp_path, monkeypatch):
    """Put the folder of the page beside the shipped makes and add its line to the registry."""
    folder = tmp_path / "makes" / "toy"
    folder.mkdir(parents=True)
    for name, code in FILES.items():
        (folder / name).write_text(code, "utf-8")
    monkeypatch.setattr(devices, "__path__", [*devices.__path__, str(folder.parent)])
    kind, name, *exports = map(ast.literal_eval, ast.parse(LINE, mode="eval").body.args)
    make = registry.Make(kind, name, *exports)
    monkeypatch.setattr(registry, "MAKES", (*registry.MAKES, make))
    yield make
    for module in [m for m in sys.modules if m.startswith("touchdown.backend.devices.toy")]:
        del sys.modules[module]
    vars(devices).pop("toy", None)


def test_the_page_has_every_file_of_a_make():
    assert set(FILES) == {"protocol.py", "driver.py", "emulator.py", "__init__.py"}


@pytest.mark.parametrize("clause", contract.CLAUSES, ids=lambda clause: clause.__name__[5:])
def test_it_keeps_the_contract_of_wrist_sensors(clause, tmp_path):
    wired = contract.Wired("toy", tmp_path)
    try:
        clause(wired)
    finally:
        wired.close()


def test_over_a_loopback_port_driver_and_emulator_agree():
    load = (1.0, 2.0, 3.0, 0.4, 0.5, 0.6)
    feels = add_noise(lambda now_s: load, (0.01,) * 6)
    emulation = emulate(EmulationChoice("toy", port=0, wrench=feels))
    settings = HardwareSettings.model_validate(tomllib.loads(bench_toml(emulation.bench)))
    assert settings.ft.address.startswith("socket://127.0.0.1:")
    driver = make_force_torque(settings, time.monotonic)
    emulation.start()
    try:
        driver.connect(5.0, threading.Event())
        assert driver.identity.maker == "Toys"
        assert driver.samples.since(0).values[0] == pytest.approx(load, abs=0.1)
    finally:
        driver.close()
        emulation.close()


def test_in_place_of_another_sensor_it_is_named():
    emulation = emulate(EmulationChoice("toy", port=0))
    sensor = emulation.fronts[0]._device
    sensor.receive(time.monotonic(), b"start\n")
    emulation.start()
    tables = {"ft": {"driver": "leptrino", "address": emulation.fronts[0].url}}
    driver = make_force_torque(HardwareSettings.model_validate(tables), time.monotonic)
    try:
        with pytest.raises(FaultError, match="a toy force/torque sensor"):
            driver.connect(2.0, threading.Event())
    finally:
        driver.close()
        emulation.close()


def test_the_command_line_and_the_device_wizard_offer_it(toy, tmp_path, capsys):
    assert main(["emulate", "toy", "--for", "0.1"]) == 0
    assert 'driver = "toy"' in capsys.readouterr().out
    assert "toy" in choices(HardwareSettings(), tmp_path)["ft.driver"]


@pytest.mark.parametrize("make", registry.MAKES, ids=lambda make: f"{make.kind} {make.name}")
def test_every_registered_export_exists(make):
    assert callable(make.load_driver())
    assert not make.emulator or callable(make.load_emulator())
    for signature in make.load_signatures():
        assert signature.decoder().feed(b"") == []


def test_names_are_unique_in_their_kind_and_as_emulators():
    names = [(make.kind, make.name) for make in registry.MAKES]
    assert len(set(names)) == len(names)
    emulated = [make for make in registry.MAKES if make.emulator]
    assert len(registry.emulated_makes()) == len(emulated)
