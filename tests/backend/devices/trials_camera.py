"""A tactile camera that sends pictures, and one fault at a random instant, by hand-wound clock.

The driver reads and judges as it does on its two threads, one picture after the other.
"""

import random
import threading
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from tests.backend.devices.trials import Ended
from touchdown.backend.config.hardware import GelsightSettings
from touchdown.backend.core import ManualClock, Stream
from touchdown.backend.devices.gelsight.driver import TactileCamera
from touchdown.backend.devices.gelsight.emulator import encode
from touchdown.backend.devices.protocols import DeviceState

PERIOD_S = 0.04
SENT_BEFORE, SENT_DURING, SENT_AFTER = 5, 14, 6
KINDS = ("frozen", "stuttering", "dark", "cut", "zeroed", "lost", "silent", "unplug", "burst")
SETTINGS = GelsightSettings(crop_fraction=0.0, silence_s=0.3, right={"file": "a pipe"})
PLUGGED = Path(__file__)  # A node that is there; who pulls the plug is told by the source
CODES = {"frozen": "CAMERA-FROZEN", "silent": "CAMERA-LINK", "unplug": "CAMERA-LINK"}
"""What the operator is told while it lasts."""


@cache
def pictures() -> tuple[bytes, ...]:
    """Bright pictures, each of its own kind."""
    rng = np.random.default_rng(3)
    count = SENT_BEFORE + SENT_DURING + SENT_AFTER
    small = rng.integers(60, 120, (count, 30, 40, 3))
    return tuple(encode(np.kron(one, np.ones((8, 8, 1))).astype(np.uint8)) for one in small)


class AtOnce:
    """In place of the room between the two threads: what is put there is taken at once."""

    skipped = 0

    def __init__(self, take) -> None:
        self._take = take

    def put(self, item) -> None:
        self._take(*item)


class Scripted:
    """A camera that sends these contents, one a period; None for none, an error for a pull."""

    lost = 0

    def __init__(self, contents, clock: ManualClock, stop: threading.Event) -> None:
        self.facts: dict[str, float] = {}
        self._contents, self._clock, self._stop = contents, clock, stop

    def read(self, limit_s: float):
        if not self._contents:
            self._stop.set()
            return None
        content, step_s = self._contents.pop(0)
        self._clock.advance(round(step_s * 1e6))
        if isinstance(content, Exception):
            raise content
        return content

    def close(self) -> None:
        """Nothing."""


class CameraTrial:
    """Draws everything from ``seed``."""

    def __init__(self, seed: int) -> None:
        self.seed, self.rng, self.clock = seed, random.Random(seed), ManualClock()
        self.told: list[str] = []
        self.camera = TactileCamera("right", SETTINGS, self.clock.now_s, Stream("right", 1000))
        self.camera._newest = AtOnce(self.camera._take)
        fail = self.camera._fail
        self.camera._fail = lambda fault: (self.told.append(fault.code), fail(fault))[1]

    def run(self) -> Ended:
        """Send, break, send again, and look."""
        fault = self.rng.choice(KINDS)
        sent = list(pictures())
        before = sent[:SENT_BEFORE]
        during = sent[SENT_BEFORE : SENT_BEFORE + SENT_DURING]
        after = sent[SENT_BEFORE + SENT_DURING :]
        damaged = getattr(self, f"_{fault}")(during)
        steady = [(content, PERIOD_S) for content in before]
        back = [(content, PERIOD_S) for content in after]
        if fault == "dark":
            steady = []
        script = [*steady, *damaged, *back]
        self._watch(script)
        return Ended(self.seed, "camera", fault, tuple(self._broken(fault, after)))

    def _watch(self, script) -> None:
        """As ``_watch`` of the driver: the camera is taken again after each loss."""
        camera = self.camera
        while script:
            stop = threading.Event()
            camera._open_camera = lambda path, settings, stop=stop: Scripted(
                script, self.clock, stop
            )
            source = camera._open_camera(camera.find(), SETTINGS)
            try:
                camera._read(source, PLUGGED, stop)
            except OSError as error:
                camera._fail(_lost(camera.name, error))
                camera.reopened += 1

    def _broken(self, fault: str, after: list[bytes]) -> list[str]:
        camera = self.camera
        frames, _, _ = camera.frames.since(0)
        images = [frame.image for frame in frames]
        runs = [np.array_equal(a, b) for a, b in pairwise(images)]
        times = [frame.t_s for frame in frames]
        wanted = CODES.get(fault)
        rows = {
            f"told {self.told}": self.told == [wanted] if wanted else not self.told,
            "three equal pictures were handed on": not any(a and b for a, b in pairwise(runs)),
            "time or number goes back": bool(np.all(np.diff(times) > 0))
            and bool(np.all(np.diff([frame.sequence for frame in frames]) > 0)),
            "a dark picture was handed on": all(
                image.mean() >= SETTINGS.darkest_mean for image in images
            ),
            f"state {camera.state}": camera.state is DeviceState.READY and camera.fault is None,
            "what came after was not handed on": len(images) >= len(after)
            and len({image.tobytes() for image in images[-len(after) :]}) == len(after),
            "another shape": {image.shape for image in images} == {(240, 320, 3)},
        }
        return [name for name, holds in rows.items() if not holds]

    # -- what goes wrong, as (content, seconds until it) ------------------------------------------

    def _frozen(self, during):
        return [(during[0], PERIOD_S)] * len(during)

    def _stuttering(self, during):
        twice = [content for content in during[:7] for _ in range(2)]
        return [(content, PERIOD_S) for content in twice]

    def _dark(self, during):
        image = np.full((240, 320, 3), 3, dtype=np.uint8)
        image[0, 0] = 9
        rows = [np.roll(image, k, axis=1) for k in range(len(during))]
        return [(encode(row), PERIOD_S) for row in rows]

    def _cut(self, during):
        return [(one[: self.rng.randrange(2, len(one) - 2)], PERIOD_S) for one in during]

    def _zeroed(self, during):
        head = self.rng.randrange(2, 20)
        return [(one[:2] + bytes(head) + one[2 + head :], PERIOD_S) for one in during]

    def _lost(self, during):
        return [(one, PERIOD_S * self.rng.choice((1, 1, 2, 5))) for one in during]

    def _silent(self, during):
        return [(None, 0.05)] * 8

    def _unplug(self, during):
        return [(OSError("the device is gone"), PERIOD_S)]

    def _burst(self, during):
        return [(during[0], 0.25), *((one, 0.001) for one in during[1:])]


def _lost(name: str, error: OSError):
    from touchdown.backend.devices.cameras.frames import link_fault

    return link_fault(name, f"The camera is lost: {error}.")


def trial(seed: int) -> Ended:
    """Run one."""
    return CameraTrial(seed).run()
