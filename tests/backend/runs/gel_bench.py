"""Two cameras with rendered gels, connected as on a real bench, with a manual clock.

Each image is a JPEG that passes the driver's filter: resting markers, noise, brightness and a slow
creep. An accepted calibration holds the fingerprints.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from tests.backend.rig.scripted import scripted
from touchdown.backend.calibration import CalibrationStore, dots_to_numbers
from touchdown.backend.calibration.result import CalibrationEstimate, Quantity
from touchdown.backend.config.hardware import GelsightSettings
from touchdown.backend.core import FINGERS, MARKERS, Stream, TactileFrame
from touchdown.backend.devices.cameras.frames import PictureFilter
from touchdown.backend.devices.gelsight.emulator import encode
from touchdown.backend.devices.protocols import GripStatus
from touchdown.backend.rig.connection import BenchConnection
from touchdown.backend.runs.calibrations import GelCheck, accept_calibration
from touchdown.backend.simulation.finger_camera import (
    TactileRenderer,
    load_gel_appearance,
    mirror_appearance,
)

LOOKS = {"left": load_gel_appearance(), "right": mirror_appearance(load_gel_appearance())}
NOBODY = np.zeros(MARKERS, dtype=bool)
PERIOD_S = 0.04
SCALES = ("left_u_mm_px", "left_v_mm_px", "right_u_mm_px", "right_v_mm_px")


class Gel:
    """Gel under a camera: three images in turn, with a uniform creep (2,) and ``light``.

    ``fitted`` transforms the images into those of another gel.
    """

    def __init__(self, look, seed: int, creep_px=(0.0, 0.0), light=1.0, fitted=np.asarray) -> None:
        self.look, optics = look, TactileRenderer(look, seed)
        moved_px = np.tile(creep_px, (MARKERS, 1))
        shown = [fitted(optics.render(moved_px, NOBODY)) for _ in range(3)]
        levels = [light * one.astype(np.float64) for one in shown]
        self._sent = [encode(np.clip(one, 0, 255).astype(np.uint8)) for one in levels]

    @cache  # noqa: B019
    def seen(self, mirror: str):
        """Return the images after the driver's filter."""
        own = {"mirror": mirror}
        gate = PictureFilter("left", "left", GelsightSettings(crop_fraction=0.0, left=own), 0.0)
        return [gate.judge(0.0, sent) for sent in self._sent]


class GelBench:
    """``gels`` by finger are under the cameras."""

    def __init__(self, folder, gels, mirror: str = "none") -> None:
        self.gels, self.mirror, self._now_s = dict(gels), mirror, 0.0
        self.frames = {finger: Stream(finger, 64) for finger in FINGERS}
        self.store = CalibrationStore(folder, "hardware")
        self.devices, self.log = scripted()
        self.holding = False
        for finger in FINGERS:
            self.devices[f"tactile_{finger}"].describe = lambda: {"mirror": self.mirror}
        self.devices["gripper"].status = lambda: GripStatus(20.0, 0.0, holding=self.holding)
        self.connection = BenchConnection(self.devices)
        self.check = GelCheck(self.store, self.devices, self.frames, lambda cancel: self.shoot())
        self.connection.prove = self.check.prove

    def shoot(self) -> None:
        """Let each camera send one image."""
        self._now_s += PERIOD_S
        for finger, gel in self.gels.items():
            number = self.frames[finger].count
            image = gel.seen(self.mirror)[number % 3]
            frame = TactileFrame(finger, number, self._now_s, image, True)
            self.frames[finger].put(self._now_s, frame)

    def calibrate(self, *, fingerprint: bool = True) -> None:
        """Accept a calibration of the present gels."""
        self._connected()
        numbers = [n for gel in self.gels.values() for n in dots_to_numbers(gel.look.rest_px)]
        codes = ("exchanged", "left_mirror", "right_mirror")
        quantities = [Quantity(name, 0.0, 0.0, "") for name in codes]
        quantities += [Quantity(name, 0.06, 0.0, "mm/px") for name in SCALES]
        found = CalibrationEstimate(
            tuple(quantities), np.zeros((7, 7)), np.zeros(4), 1.7, 3.0, "px"
        )
        accept_calibration(
            self.store,
            replace(found, gels_px=tuple(numbers if fingerprint else ())).to_event(0.0, "camera"),
            self.devices,
        )

    def connect(self) -> dict[str, str]:
        """Reconnect; return the fault code of each refused device."""
        return {name: fault.code for name, fault in self.faults().items()}

    def faults(self):
        """Reconnect; return the fault of each refused device."""
        self._connected()
        return {line.name: line.fault for line in self.connection.lines() if line.fault}

    def _connected(self) -> None:
        self.connection.begin(tuple(self.devices))
        assert self.connection.wait(60.0)
