"""Pictures of real gels as a camera sends them, one of them damaged, and what becomes of it.

The stream runs through the gate of the driver and the checked tracker, as on a bench; the truth is
what the same tracker makes of the undamaged picture.
"""

import copy
import random
from collections import Counter
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from touchdown.backend.config.hardware import GelsightSettings
from touchdown.backend.core.values import TactileFrame
from touchdown.backend.devices.cameras.frames import PictureFilter
from touchdown.backend.sensing.jpeg_damage import DamageCheckingTracker
from touchdown.backend.sensing.picture_files import read_pictures

GELSIGHT = Path(__file__).resolve().parents[3] / "data" / "gelsight"
SCENES = (
    ("plug_3D_exp3_camera_2.avi", 60),
    ("blue_box_exp2_camera_2.avi", 200),
    ("avocado_real_exp1_camera_2.avi", 300),
    ("screw_driver_red_exp1_camera_2.avi", 100),
)
"""Clip and number of the picture that is damaged; four before it are sent whole."""
BEFORE = 4
PERIOD_S = 0.04
NATIVE = (3280, 2464)
NATIVE_CROP = 0.15
WRONG_PX, OFF_PX = 2.0, 0.2


def cut(content: bytes, draw: random.Random) -> bytes:
    """Only the beginning."""
    return content[: draw.randrange(700, len(content) - 1)]


def one_bit(content: bytes, draw: random.Random) -> bytes:
    """One bit the other way round."""
    at = draw.randrange(8 * len(content))
    flipped = content[at // 8] ^ (1 << at % 8)
    return content[: at // 8] + bytes((flipped,)) + content[at // 8 + 1 :]


def zeros(content: bytes, draw: random.Random) -> bytes:
    """64 bytes of zeros."""
    at = draw.randrange(len(content) - 64)
    return content[:at] + bytes(64) + content[at + 64 :]


def lost_packet(content: bytes, draw: random.Random) -> bytes:
    """1 KiB missing."""
    at = draw.randrange(len(content) - 1024)
    return content[:at] + content[at + 1024 :]


KINDS = {"cut off": cut, "one bit": one_bit, "64 bytes zeroed": zeros, "1 KiB lost": lost_packet}


class DamagedStream:
    """One scene at one size: sends its whole pictures, then any number of damaged ones instead of
    the last, each as if it were the first.
    """

    def __init__(self, clip: str, at: int, *, native: bool, quality: int = 90) -> None:
        crop = NATIVE_CROP if native else 0.0
        self._settings = GelsightSettings(crop_fraction=crop)
        found = islice(read_pictures(GELSIGHT / clip), at - BEFORE, at + 1)
        *before, last = [encoded(frame.image, quality, native=native) for frame in found]
        self.content = last
        self._gate = PictureFilter("left", "tactile_left", self._settings, 0.0)
        self._tracker = DamageCheckingTracker("left")
        for k, content in enumerate(before):
            assert self._send(self._gate, self._tracker, k, content) is not None
        truth = self._send(*self._fresh(), BEFORE, last)
        assert truth is not None
        self._truth_px = truth.position_px

    def outcome(self, content: bytes) -> str:
        """Return who refused ``content``, or how far its worst marker is off."""
        gate, tracker = self._fresh()
        field = self._send(gate, tracker, BEFORE, content)
        if gate.invalid:
            return "bytes"
        if field is None:
            return "content"
        worst_px = float(np.linalg.norm(field.position_px - self._truth_px, axis=1).max())
        return "wrong" if worst_px > WRONG_PX else "off" if worst_px > OFF_PX else "right"

    def _fresh(self) -> tuple[PictureFilter, DamageCheckingTracker]:
        # The detector has buffers that are views of each other: all copies share the one.
        detector = self._tracker.tracker._detector
        return copy.deepcopy(self._gate), copy.deepcopy(self._tracker, {id(detector): detector})

    def _send(self, gate, tracker, k, content):
        image = gate.judge(PERIOD_S * k, content)
        if image is None:
            return None
        return tracker.track(TactileFrame("left", k, PERIOD_S * k, image, from_jpeg=True))


def encoded(image: np.ndarray, quality: int = 90, *, native: bool) -> bytes:
    """Return a picture as a camera sends it, enlarged to the native size with its border."""
    if native:
        kept = [round(side * (1 - 2 * NATIVE_CROP)) for side in NATIVE]
        rows, columns = (round(side * NATIVE_CROP) for side in NATIVE[::-1])
        image = cv2.resize(image, kept, interpolation=cv2.INTER_CUBIC)
        image = cv2.copyMakeBorder(image, rows, rows, columns, columns, cv2.BORDER_REFLECT)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def native_pictures(clip: str, at: int, count: int) -> list[bytes]:
    """Return ``count`` pictures of a clip from number ``at`` on, at native size."""
    found = islice(read_pictures(GELSIGHT / clip), at, at + count)
    return [encoded(frame.image, native=True) for frame in found]


def outcomes(kind: str, count: int, seed: int, *, native: bool = False) -> Counter[str]:
    """Damage ``count`` pictures, shared out over the scenes; count what becomes of them."""
    draw, found = random.Random(seed), Counter[str]()
    for clip, at in SCENES:
        stream = DamagedStream(clip, at, native=native)
        for _ in range(count // len(SCENES)):
            found[stream.outcome(KINDS[kind](stream.content, draw))] += 1
    return found
