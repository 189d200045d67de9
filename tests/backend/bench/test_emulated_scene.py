"""Emulated bench in its own process, and its ground truth.

No trial runs here: real time on a busy machine proves nothing. See tests/bench/wired.py for
measured figures.
"""

import io
import json
import os
import re
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tests.backend.devices.waiting import until
from touchdown.backend.bench import (
    EmulatedBench,
    EmulatedScene,
    SimulatedBenchChoice,
    make_scene,
    serve_bench,
)
from touchdown.backend.bench.emulated import BACKEND_LATE_S, REPLY_LATE_S, real_time_notice
from touchdown.backend.bench.emulated_child import EmulatedProcess, serve
from touchdown.backend.bench.emulated_scene import (
    BENCH_FILE,
    WORK_S,
    TruthClient,
    TruthServer,
    longest_delay_s,
    processor_share,
)
from touchdown.backend.config import HardwareSettings, read_settings
from touchdown.backend.core import FaultError, SampleStream, round_robin_priority
from touchdown.backend.core.scheduling import SLICE_NS
from touchdown.backend.devices.interlock import LEASE_S, Interlock, Limits
from touchdown.backend.devices.melfa.emulator import TIMEOUT_CYCLES
from touchdown.backend.emulation import FaultPlan, TcpServer
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.rig.link import RigLink
from touchdown.backend.runs.requests import CollectRequest, SceneChoice

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
    with pytest.raises(FaultError, match="emulated bench has ended"):
        truth.truth()


@pytest.mark.promise("P7", "P10")
def test_a_bench_whose_process_is_dead_is_a_fault(monkeypatch):
    monkeypatch.setattr("touchdown.backend.bench.emulated_child.sys.executable", "/bin/true")
    told = []
    process = EmulatedProcess(told.append)
    with pytest.raises(FaultError, match="has ended"):
        process.set_scene(CHOICE, SETTINGS, FaultPlan(), Path("nowhere"), None, threading.Event())
    until(lambda: told)
    process.close()
    assert [fault.code for fault in told] == ["BENCH-GONE"]


@pytest.mark.promise("P7", "P10")
def test_a_process_that_never_sets_its_scene_is_a_fault_and_the_next_scene_gets_another(
    monkeypatch, tmp_path
):
    silent = tmp_path / "silent"
    silent.write_text("#!/bin/sh\nexec sleep 600\n")
    silent.chmod(0o755)
    monkeypatch.setattr("touchdown.backend.bench.emulated_child.sys.executable", str(silent))
    monkeypatch.setattr("touchdown.backend.bench.emulated_child.REST_S", 0.1)
    told = []
    process = EmulatedProcess(told.append)
    for _ in range(2):
        with pytest.raises(FaultError, match="SCENE-NOT-SET"):
            process.set_scene(
                CHOICE, SETTINGS, FaultPlan(), Path("nowhere"), None, threading.Event()
            )
        assert process._child is None
    process.close()
    assert told == []


def test_a_cancelled_start_does_not_wait_for_the_scene(monkeypatch, tmp_path):
    silent = tmp_path / "silent"
    silent.write_text("#!/bin/sh\nexec sleep 600\n")
    silent.chmod(0o755)
    monkeypatch.setattr("touchdown.backend.bench.emulated_child.sys.executable", str(silent))
    process, cancel = EmulatedProcess(lambda fault: None), threading.Event()
    cancel.set()
    with pytest.raises(FaultError, match="SCENE-NOT-SET"):
        process.set_scene(CHOICE, SETTINGS, FaultPlan(), tmp_path, None, cancel)
    assert process._child is None


def test_the_process_of_the_emulated_bench_ends_silently_after_the_program():
    class Gone(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

    serve([json.dumps({"measure_s": 0.01}) + "\n"], Gone())


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="needs priorities of Linux")
def test_no_thread_of_the_emulated_bench_lacks_its_priority(tmp_path):
    """A thread without it keeps the interpreter lock from the others on a busy computer."""
    with round_robin_priority(1) as granted:
        pass
    process = EmulatedProcess(lambda fault: None)
    try:
        process.set_scene(CHOICE, SETTINGS, FaultPlan(), tmp_path, None, threading.Event())
        tasks = Path(f"/proc/{process._child.pid}/task").iterdir()
        policies = {os.sched_getscheduler(int(task.name)) for task in tasks}
    finally:
        process.close()
    if granted:
        assert policies <= {os.SCHED_RR, os.SCHED_FIFO}


def test_delays_that_real_time_does_not_bear_are_said_at_the_start():
    assert real_time_notice(0.034, 0.09, 0.5) == ""
    late = real_time_notice(0.036, 0.0, 1.0)
    assert "arm's replies, so that presses are void (36 ms late" in late
    assert "samples and pictures" not in late
    assert "samples and pictures" in real_time_notice(0.0, 0.0, 0.05)
    assert "(5 % of a core" in real_time_notice(0.0, 0.0, 0.05).replace("%", " %")
    both = real_time_notice(0.05, 0.2, 1.0)
    assert "50 ms late, limit 35 ms" in both
    assert "200 ms late, limit 100 ms" in both


def test_delays_are_measured_in_the_process_of_the_devices_at_the_work_of_a_run(monkeypatch):
    begun_s = time.thread_time()
    assert longest_delay_s(0.1, WORK_S) >= 0.0
    assert time.thread_time() - begun_s >= 5 * WORK_S
    assert 0.0 < processor_share(0.01) <= 1.1
    answers = io.StringIO()
    serve([json.dumps({"measure_s": 0.01}) + "\n"], answers)
    assert float(answers.getvalue()) >= 0.0
    bench = EmulatedBench(SimulatedBenchChoice(preset="quiet"))
    monkeypatch.setattr(bench._process, "longest_delay_s", lambda seconds: 0.05)
    assert "50 ms late, limit 35 ms" in bench.measure_real_time(0.01)
    bench.close()


def test_rig_and_emulated_devices_have_sessions_of_their_own_and_short_slices(tmp_path):
    """Linux shares processor time between sessions, and wakes threads of short slices first."""
    process = EmulatedProcess(lambda fault: None)
    try:
        process.set_scene(CHOICE, SETTINGS, FaultPlan(), tmp_path, None, threading.Event())
        devices = process._child.pid
        hardware = read_settings(HardwareSettings, tmp_path / BENCH_FILE)
        link = RigLink(
            hardware, time.monotonic, SampleStream("force_torque", 6, 99),
            SampleStream("arm", 3, 99), Interlock(),
        )  # fmt: skip
        try:
            link.start()
            rig = link._child.pid
            sessions = {os.getsid(pid) for pid in (0, devices, rig)}
            slices = {slice_ns(pid) for pid in (devices, rig)}
        finally:
            link.close()
    finally:
        process.close()
    assert len(sessions) == 3
    assert slices <= {SLICE_NS, None}


def slice_ns(pid: int) -> int | None:
    """Return the slice of a thread in ns, None for one at real-time priority or if unknown."""
    if os.sched_getscheduler(pid) != os.SCHED_OTHER or not Path(f"/proc/{pid}/sched").is_file():
        return None
    found = re.search(r"se\.slice\s*:\s*(\d+)", Path(f"/proc/{pid}/sched").read_text())
    return None if found is None else int(found[1])


def test_the_bytes_of_the_wrist_sensor_wait_for_no_thread_of_the_system(tmp_path):
    process = EmulatedProcess(lambda fault: None)
    try:
        process.set_scene(CHOICE, SETTINGS, FaultPlan(), tmp_path, None, threading.Event())
        hardware = read_settings(HardwareSettings, tmp_path / BENCH_FILE)
    finally:
        process.close()
    assert hardware.ft.address.startswith("socket://")


def test_a_busy_computer_changes_no_limit_of_a_device():
    limits = Limits()
    assert (limits.wrench_age_s, limits.frame_age_s, LEASE_S) == (0.3, 0.5, 0.25)
    assert (TIMEOUT_CYCLES, HardwareSettings().melfa.realtime_priority) == (57, 50)
    assert (REPLY_LATE_S, BACKEND_LATE_S) == (0.035, 0.1)


def test_a_strike_reaches_its_device_and_commands_are_kept(tmp_path):
    scene = make_scene(load_pieces(), CHOICE, SETTINGS)
    joined, emulation = serve_bench(scene, tmp_path, FaultPlan())
    front = TcpServer(TruthServer(joined))
    for part in emulation.fronts:
        part.faults.begin(time.monotonic())
    front.start()
    truth = TruthClient(scene, front.address)
    truth.strike("force_torque", "silent", 1e4)
    assert joined.faults["force_torque"].active("silent", time.monotonic())
    assert not joined.faults["gripper"].active("silent", time.monotonic())
    joined.step()
    ((at_s, start_mm),) = joined._commands
    joined._commands.append((at_s + 0.01, start_mm + np.array([0.3, 0.4, 2.0])))
    assert truth.command_travel(at_s) == pytest.approx((0.5, 0.0, 2.0))
    assert truth.command_travel(at_s + 1.0) == (0.0, 0.0, 0.0)
    front.close()
    for part in emulation.fronts:
        part.close()


def test_recordings_of_an_emulated_bench_say_so():
    bench = EmulatedBench(SimulatedBenchChoice(preset="quiet"))
    bench.session._plan(CollectRequest(person="ann"))
    assert bench.session.mode == "emulated"
    bench.close()
