"""A whole emulated bench behind real wires, and the bench file that leads to it."""

from __future__ import annotations

import gc
import sys
from collections.abc import Mapping
from pathlib import Path

from backend.config.hardware import HardwareSettings
from backend.core.flow import FINGERS, Finger
from backend.emulators.faults import FaultPlan, Faults
from backend.emulators.front import Front, PtyFront, TcpFront
from backend.emulators.gelsight import GelsightFront
from backend.emulators.joined import LATENCY_S, JoinedDynpick, JoinedScene, JoinedWsg
from backend.emulators.melfa import TIMEOUT_CYCLES, MelfaFront
from backend.emulators.serving import Emulation, bench_toml, camera_tables, melfa_tables
from backend.simulation.scene import Scene

SERIALS: Mapping[Finger, str] = {"left": "LEFT-0001", "right": "RGHT-0001"}
BENCH_FILE = "bench.toml"
LAB_HEAD = """\
# Lab file of an emulated bench: it holds as long as the bench is served.
version = 1
name = "Rehearsal"
kind = "emulated"
piece = "{piece}"
bottom = "{bottom}"

"""
POLL_HZ = 100.0
"""How often the cameras are asked for a new picture: once a cycle of the world, which takes them at
the rate of the scene."""

PRIORITY = 20
"""Real-time priority of all devices: what they stand for loses no time to this computer's other
work. Below that of the rig."""
SENSOR_TICK_S = 0.004
"""About a cycle of the arm, which feels once a cycle; each look wakes sensor and driver."""

SWITCH_S = 0.0005
"""Python's own 5 ms, waited for by thread after thread, made the arm miss ten cycles at a time."""


def take_short_turns() -> None:
    """For the process that serves a bench: no thread waits long behind those that render.

    What was made so far stays, so the collector need not look through it either.
    """
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()


def serve_bench(
    scene: Scene, folder: Path, plan: FaultPlan, host: str = "127.0.0.1"
) -> tuple[JoinedScene, Emulation]:
    """Make arm, gripper, wrist sensor and both cameras of ``scene``; ports are free ones.

    ``folder`` takes the links of sensor and cameras, and the bench file. Raises ``OSError``.
    """
    settings = HardwareSettings.model_validate({"melfa": {"mxt": {"mxttout": TIMEOUT_CYCLES}}})
    joined = JoinedScene(scene, settings.melfa)
    folder.mkdir(parents=True, exist_ok=True)
    arm = MelfaFront(joined.melfa, host, faults=Faults("arm", plan))
    gripping = Faults("gripper", plan)
    gripper = TcpFront(JoinedWsg(joined, gripping), host, faults=gripping)
    sensor = _sensor(joined, folder, Faults("force_torque", plan), host)
    cameras = [_camera(joined, finger, folder, plan) for finger in FINGERS]
    joined.priority = PRIORITY
    for front in (arm, gripper, sensor, *cameras):
        front.priority = PRIORITY
    tables: dict[str, Mapping[str, object]] = {
        **melfa_tables(arm),
        "wsg": {"host": host, "port": gripper.address[1]},
        "ft": {"driver": "dynpick", "address": sensor.url, "latency_ms": 1e3 * LATENCY_S},
        **camera_tables(folder, SERIALS),
    }
    (folder / BENCH_FILE).write_text(bench_toml(tables), "utf-8")
    return joined, Emulation((arm, gripper, sensor, *cameras), tables)


def lab_toml(scene: Scene, emulation: Emulation) -> str:
    """Return a lab file that leads to an emulated bench, with what a lab would have measured."""
    wrist, tactile = scene.settings.wrist, scene.settings.tactile
    bottoms = "+".join(body.name for body in scene.bottoms.bodies)
    tables = {name: dict(table) for name, table in emulation.bench.items()}
    tables["gelsight"] |= {
        "mm_per_px_x": tactile.mm_per_px[0],
        "mm_per_px_y": tactile.mm_per_px[0],
    }
    mounting = {
        "sensor_height_mm": wrist.height_mm,
        "sensor_yaw_rad": wrist.yaw_rad,
        "payload_kg": wrist.payload_kg,
        "payload_com_mm": list(wrist.payload_com_mm),
    }
    return LAB_HEAD.format(piece=scene.piece.name, bottom=bottoms) + bench_toml(
        {"mounting": mounting, **tables}
    )


def _sensor(joined: JoinedScene, folder: Path, faults: Faults, host: str) -> Front:
    device = JoinedDynpick(joined, faults)
    front: TcpFront | PtyFront
    if sys.platform == "win32":
        front = TcpFront(device, host, faults=faults)
    else:
        front = PtyFront(device, faults=faults, link=folder / "force_torque")
    front.tick_s = SENSOR_TICK_S
    return front


def _camera(joined: JoinedScene, finger: Finger, folder: Path, plan: FaultPlan) -> GelsightFront:
    faults = Faults(f"tactile_{finger}", plan)
    return GelsightFront(
        lambda now_s: joined.picture(finger),
        folder,
        SERIALS[finger],
        rate_hz=POLL_HZ,
        faults=faults,
    )
