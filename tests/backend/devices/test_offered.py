"""Drivers are found by name: shipped ones first, then those of installed packages."""

import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.devices import registry
from touchdown.backend.devices.factories import make_force_torque, make_gripper
from touchdown.backend.devices.wsg.driver import WsgGripper


def settings(**tables):
    return HardwareSettings.model_validate(tables)


def offer(monkeypatch, name, load):
    point = SimpleNamespace(name=name, load=load)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point])


def test_an_installed_language_is_made_with_settings_and_address(monkeypatch):
    made = []
    offer(monkeypatch, "mine", lambda: lambda *given: made.append(given))
    content = settings(ft={"driver": "mine", "address": "/dev/mine"})
    make_force_torque(content, time.monotonic)
    assert made == [(content, "/dev/mine")]


def test_an_installed_gripper_is_used(monkeypatch):
    offer(monkeypatch, "claw", lambda: lambda settings, now_s: "a claw")
    assert make_gripper(settings(wsg={"driver": "claw"}), time.monotonic) == "a claw"
    assert isinstance(make_gripper(settings(), time.monotonic), WsgGripper)


def test_a_driver_that_ships_is_not_replaced(monkeypatch):
    offer(monkeypatch, "wsg", lambda: pytest.fail("not asked for"))
    assert isinstance(make_gripper(settings(), time.monotonic), WsgGripper)


def broken():
    raise ImportError("no module named 'my_lab'")


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"ft": {"driver": "thine", "address": "x"}}, "no driver 'thine'.*dynpick.*mine"),
        ({"ft": {"driver": "mine", "address": "x"}}, "cannot be loaded.*my_lab"),
        ({"ft": {"driver": "dynpick"}}, "no address"),
        ({"ft": {"driver": "optoforce", "address": "x"}}, "scale"),
        ({}, "real-time monitor is not known"),
    ],
)
def test_what_cannot_be_made_is_one_error(monkeypatch, tables, said):
    offer(monkeypatch, "mine", broken)
    with pytest.raises(InputError, match=said):
        make_force_torque(settings(**tables), time.monotonic)


LOAD_ALL = """
import sys
import touchdown.backend.rig.process
from touchdown.backend.devices import registry
from touchdown.backend.devices.identification import load_signatures
for make in registry.MAKES:
    if make.kind != "tactile":
        make.load_driver()
load_signatures()
heavy = ("PySide6", "torch", "cv2", "touchdown.backend.simulation", "touchdown.backend.emulation",
         "touchdown.backend.devices.cameras", "touchdown.backend.sensing", "touchdown.backend.runs")
print(*sorted(name for name in sys.modules if name.startswith(heavy)))
"""


def test_no_driver_loads_what_the_rig_process_must_not():
    done = subprocess.run([sys.executable, "-c", LOAD_ALL], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr
