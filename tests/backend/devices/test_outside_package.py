"""A package of somebody else: the class of the guide, found by entry point, keeps the contract."""

import re
import sys
import threading
from pathlib import Path

import pytest

from tests.backend.devices import test_force_torque_contract as contract
from touchdown.backend.devices.factories import make_force_torque
from touchdown.backend.emulation.fault_plan import SampleSchedule

GUIDE = Path(__file__).resolve().parents[3] / "docs" / "hardware.md"
PERIOD_S = 0.005
CLAUSES = [
    contract.test_it_delivers_what_the_sensor_feels_in_order_at_its_rate,
    contract.test_garbage_is_refused_counted_and_overcome,
    contract.test_a_frozen_sensor_gives_no_measurement,
    contract.test_the_end_of_the_range_is_a_fault_and_no_number,
    contract.test_unplugged_it_is_a_fault_and_plugged_in_again_it_heals,
    contract.test_connecting_can_be_cancelled_and_closing_twice_is_allowed,
]


class EmulatedSixNumbers:
    """Six numbers a line, from "start" to "stop"."""

    def __init__(self, wrench):
        self._wrench, self._pace = wrench, SampleSchedule()

    def receive(self, now_s, data):
        if b"start" in data and not self._pace.running:
            self._pace.begin(now_s, PERIOD_S)
        if b"stop" in data:
            self._pace.end()
        return b""

    def due(self, now_s):
        _, times = self._pace.due(now_s)
        return b"".join(self._line(t_s) for t_s in times)

    def closed(self, now_s):
        """Nothing."""

    def _line(self, t_s):
        values = (min(max(value, -1e5), 1e5) for value in self._wrench(t_s))
        return (",".join(f"{value:.4f}" for value in values) + "\n").encode()


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Put the class of the guide on the path, with the metadata of an installed package."""
    text = GUIDE.read_text("utf-8")
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL)
               if "class MyLanguage" in block]  # fmt: skip
    package = tmp_path / "my_lab"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "my_sensor.py").write_text(code, "utf-8")
    (toml,) = [block for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
               if "touchdown.force_torque" in block]  # fmt: skip
    (place,) = re.findall(r'^mine = "(.+?)"', toml, re.MULTILINE)
    info = tmp_path / "my_lab-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-lab\nVersion: 1.0\n", "utf-8")
    points = f"[touchdown.force_torque]\nmine = {place}\n"
    (info / "entry_points.txt").write_text(points, "utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    for name in ("my_lab", "my_lab.my_sensor"):
        sys.modules.pop(name, None)


@pytest.fixture
def wired(installed, tmp_path, monkeypatch):
    monkeypatch.setitem(contract.EMULATED, "mine", EmulatedSixNumbers)
    monkeypatch.setitem(contract.RATE_HZ, "mine", 1.0 / PERIOD_S)
    made = contract.Wired("mine", tmp_path)
    yield made
    made.close()


@pytest.mark.parametrize("clause", CLAUSES, ids=lambda clause: clause.__name__[5:])
def test_the_class_of_the_guide_keeps_the_contract(clause, wired):
    clause(wired)


def test_it_is_the_outside_class_that_answers(wired):
    assert make_force_torque is contract.make_force_torque
    wired.driver.connect(5.0, threading.Event())
    assert wired.driver.identity.maker == "My Lab"
    assert "my_lab.my_sensor" in sys.modules
