"""Emulated bench in its own process, and its ground truth.

No trial runs here: real time on a busy machine proves nothing. See tests/bench/wired.py for
measured figures.
"""

import io
import json
import tempfile
from pathlib import Path

import pytest

from tests.backend.devices.waiting import until
from touchdown.backend.bench.assembly import SimulatedBenchChoice, make_scene
from touchdown.backend.bench.emulated_child import EmulatedProcess, serve
from touchdown.backend.bench.emulated_scene import (
    BENCH_FILE,
    EmulatedScene,
    TruthClient,
    TruthServer,
)
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.config.toml_file import read_settings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.emulation.fault_plan import FaultPlan
from touchdown.backend.emulation.server import TcpServer
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.requests import SceneChoice

SETTINGS = SimulatedBenchChoice(preset="quiet").settings()
CHOICE = SceneChoice("pot", ("short",), 3)


def order(folder):
    choice = {"piece": "pot", "bottoms": ["short"], "seed": 3}
    settings, plan = SETTINGS.model_dump(mode="json"), FaultPlan().model_dump(mode="json")
    content = {"choice": choice, "settings": settings, "plan": plan}
    return json.dumps({**content, "folder": str(folder), "pieces": None}) + "\n"


def test_each_line_is_a_scene_with_a_bench_file_that_loads():
    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as second:
        answers = io.StringIO()
        serve([order(first), order(second)], answers)
        hosts = [json.loads(line)[0] for line in answers.getvalue().splitlines()]
        assert hosts == ["127.0.0.1"] * 2
        hardware = read_settings(HardwareSettings, Path(second) / BENCH_FILE)
        assert hardware.ft.driver == "dynpick"
        assert hardware.gelsight.left.serial != hardware.gelsight.right.serial
        assert hardware.melfa.mxt.mxttout == 57


def test_the_truth_is_that_of_the_scene():
    scene = make_scene(load_pieces(), CHOICE, SETTINGS)
    joined = EmulatedScene(scene, HardwareSettings().melfa)
    front = TcpServer(TruthServer(joined))
    front.start()
    truth = TruthClient(scene, front.address)
    assert truth.scene is scene
    assert truth.truth() == joined.truth()
    front.close()
    with pytest.raises(OSError, match=r"refused|closed|gone"):
        truth.truth()


@pytest.mark.promise("P7", "P10")
def test_a_bench_whose_process_is_dead_is_a_fault(monkeypatch):
    monkeypatch.setattr("touchdown.backend.bench.emulated_child.sys.executable", "/bin/true")
    told = []
    process = EmulatedProcess(told.append)
    with pytest.raises(FaultError, match="has ended"):
        process.set_scene(CHOICE, SETTINGS, FaultPlan(), Path("nowhere"))
    until(lambda: told)
    process.close()
    assert [fault.code for fault in told] == ["BENCH-GONE"]


@pytest.mark.promise("P7", "P10")
def test_a_process_that_never_sets_its_scene_is_a_fault_and_the_next_scene_gets_another(
    monkeypatch, tmp_path
) -> None:
    silent = tmp_path / "silent"
    silent.write_text("#!/bin/sh\nexec sleep 600\n")
    silent.chmod(0o755)
    monkeypatch.setattr("touchdown.backend.bench.emulated_child.sys.executable", str(silent))
    monkeypatch.setattr("touchdown.backend.bench.emulated_child.REST_S", 0.1)
    told = []
    process = EmulatedProcess(told.append)
    for _ in range(2):
        with pytest.raises(FaultError, match="SCENE-NOT-SET"):
            process.set_scene(CHOICE, SETTINGS, FaultPlan(), Path("nowhere"))
        assert process._child is None
    process.close()
    assert told == []
