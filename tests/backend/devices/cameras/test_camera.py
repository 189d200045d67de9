"""The camera driver against emulated cameras in a folder, and real clips through the live path."""

import sys
import threading
import time
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.backend.devices.waiting import until
from touchdown.backend.config.hardware import GelsightSettings
from touchdown.backend.core import (
    MARKERS,
    FaultError,
    MarkerState,
    RawStreams,
    SampleStream,
    Stream,
)
from touchdown.backend.devices.cameras import frames
from touchdown.backend.devices.cameras.sources import FileSource
from touchdown.backend.devices.gelsight import GelsightServer, TactileCamera
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.emulation.fault_plan import Faults
from touchdown.backend.sensing import LiveSensing, read_pictures

CLIP = Path(__file__).parents[3] / "data" / "gelsight" / "plug_3D_exp3_camera_2.avi"
RATE_HZ = 100.0
SERIALS = {"left": "2D8Y-69GR", "right": "AAAA-1111"}
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="named pipes")


def numbered(seed):
    """Bright pictures, each of its own kind."""
    rng = np.random.default_rng(seed)
    base = 40 + 60 * seed

    def seen(now_s):
        noise = rng.integers(0, 40, (30, 40, 3))
        return np.asarray(np.kron(base + noise, np.ones((8, 8, 1))), dtype=np.uint8)

    return seen


class Cameras:
    """Two emulated cameras in one folder, and the settings that find them."""

    def __init__(self, folder):
        self.fronts = {}
        for seed, (finger, serial) in enumerate(SERIALS.items()):
            faults = Faults(f"tactile_{finger}")
            front = GelsightServer(numbered(seed), folder, serial, rate_hz=RATE_HZ, faults=faults)
            self.fronts[finger] = front
            front.start()
        places = {name: str(folder / where) for name, where in PLACES.items()}
        fingers = {finger: {"serial": serial} for finger, serial in SERIALS.items()}
        content = {**places, **fingers, "crop_fraction": 0.0, "silence_s": 0.3}
        self.settings = GelsightSettings.model_validate(content)
        self.driver = TactileCamera("left", self.settings, time.monotonic)

    def connect(self):
        self.driver.connect(60.0, threading.Event())

    def close(self):
        self.driver.close()
        for front in self.fronts.values():
            front.close()


PLACES = {"by_id": "by-id", "names": "names", "nodes": "nodes"}


@pytest.fixture
def cameras(tmp_path):
    made = Cameras(tmp_path)
    yield made
    made.close()


def more(driver, count):
    begin = driver.frames.count
    until(lambda: driver.frames.count >= begin + count)
    return driver.frames.since(begin)[0]


def test_it_delivers_the_pictures_of_its_own_camera_in_order(cameras):
    cameras.connect()
    driver = cameras.driver
    assert driver.state is DeviceState.READY
    assert driver.identity.serial == SERIALS["left"]
    frames = more(driver, 10)
    assert {frame.image.shape for frame in frames} == {(240, 320, 3)}
    assert np.all(np.diff([frame.sequence for frame in frames]) >= 1)
    assert np.all(np.diff([frame.t_s for frame in frames]) > 0)
    assert all(40 <= frame.image.mean() <= 80 for frame in frames)
    with pytest.raises(ValueError, match="read-only"):
        frames[0].image[0, 0, 0] = 1
    assert driver.health.received >= 10
    assert all(isinstance(value, str | float | int) for value in driver.describe().values())


@pytest.mark.promise("C1")
def test_a_replugged_camera_is_found_on_its_new_node_and_no_other_taken(cameras):
    cameras.connect()
    before = cameras.driver.find().resolve()
    cameras.fronts["left"].inject("unplug")
    until(lambda: cameras.driver.state is DeviceState.FAULT)
    assert cameras.driver.fault.code == "CAMERA-LINK"
    cameras.fronts["left"].faults.clear()
    until(lambda: cameras.driver.state is DeviceState.READY)
    assert cameras.driver.find().resolve() != before
    assert cameras.driver.reopened == 1
    assert all(40 <= frame.image.mean() <= 80 for frame in more(cameras.driver, 3))


class Pulled:
    """Gives the picture it had last for ever, once its file is gone."""

    def __init__(self, path):
        self.facts, self.lost = {}, 0
        self._path, self._number = path, 0

    def read(self, limit_s):
        threading.Event().wait(0.005)
        self._number += self._path.exists()
        return np.full((240, 320, 3), 60 + self._number % 60, np.uint8)

    def close(self):
        pass


@pytest.mark.promise("C1")
def test_a_camera_that_is_gone_is_given_up_though_pictures_can_still_be_read(tmp_path):
    path = tmp_path / "video8"
    path.touch()
    settings = GelsightSettings.model_validate({"left": {"file": str(path)}, "crop_fraction": 0.0})
    driver = TactileCamera("left", settings, time.monotonic, open_camera=lambda *_: Pulled(path))
    try:
        driver.connect(60.0, threading.Event())
        path.unlink()
        until(lambda: driver.reopened)
        assert driver.health.lost > 0
    finally:
        driver.close()


def test_a_frozen_picture_is_not_delivered_and_soon_a_fault(cameras):
    cameras.connect()
    cameras.fronts["left"].inject("freeze")
    until(lambda: cameras.driver.fault is not None)
    assert cameras.driver.fault.code == "CAMERA-FROZEN"
    frames, _, _ = cameras.driver.frames.since(0)
    runs = [np.array_equal(a.image, b.image) for a, b in pairwise(frames)]
    assert sum(runs) <= 1
    cameras.fronts["left"].faults.clear()
    until(lambda: cameras.driver.state is DeviceState.READY)
    assert cameras.driver.fault is None


@pytest.mark.promise("C4")
def test_damaged_pictures_are_left_out_and_counted(cameras):
    cameras.connect()
    cameras.fronts["left"].inject("cut", share=0.5)
    until(lambda: cameras.driver.health.lost > 0)
    assert all(40 <= frame.image.mean() <= 80 for frame in more(cameras.driver, 5))
    assert cameras.driver.state is DeviceState.READY
    assert cameras.driver.health.lost > 0


@pytest.mark.promise("C7")
def test_dark_pictures_at_the_start_are_dropped(cameras):
    cameras.fronts["left"].inject("dark", 0.2)
    cameras.connect()
    frames, _, _ = cameras.driver.frames.since(0)
    assert frames[0].image.mean() > cameras.settings.darkest_mean


@pytest.mark.promise("C7")
def test_a_camera_that_stays_dark_is_refused_and_lamps_that_fail_later_are_a_fault(
    cameras, monkeypatch
):
    monkeypatch.setattr(frames, "DARK_S", 0.5)  # shorter than the time to connect
    cameras.fronts["left"].inject("dark")
    threading.Event().wait(10.0 / RATE_HZ)  # a bright picture may have been in preparation
    with pytest.raises(FaultError, match="left tactile camera stay dark") as error:
        cameras.driver.connect(2.0, threading.Event())
    assert error.value.fault.code == "CAMERA-DARK"
    cameras.fronts["left"].faults.clear()
    cameras.connect()
    cameras.fronts["left"].inject("fade")
    until(lambda: cameras.driver.fault is not None)
    assert cameras.driver.fault.code == "CAMERA-DARK"
    shown, _, _ = cameras.driver.frames.since(0)
    assert all(frame.image.mean() >= cameras.settings.darkest_mean for frame in shown)


@pytest.mark.promise("C6")
def test_a_camera_that_is_not_there_is_named_with_those_that_are(cameras):
    settings = cameras.settings.model_copy(
        update={"left": cameras.settings.left.model_copy(update={"serial": "ZZZZ-0000"})}
    )
    driver = TactileCamera("left", settings, time.monotonic)
    with pytest.raises(FaultError, match=r"'ZZZZ-0000'.*2D8Y-69GR, AAAA-1111"):
        driver.connect(0.2, threading.Event())
    assert driver.state is DeviceState.CLOSED


def test_connecting_can_be_cancelled(cameras):
    cancel = threading.Event()
    cancel.set()
    cameras.fronts["left"].inject("silent")
    # A picture may have come before: cancelled is cancelled.
    with pytest.raises(FaultError, match="cancelled"):
        cameras.driver.connect(60.0, cancel)
    assert cameras.driver.state is DeviceState.CLOSED


class Blocking:
    """A camera whose read does not come back until the test lets it."""

    def __init__(self):
        self.facts, self.lost = {}, 0
        self.let_go = threading.Event()

    def read(self, limit_s):
        self.let_go.wait(240.0)

    def close(self):
        pass


@pytest.mark.promise("C2")
def test_a_read_that_blocks_holds_up_neither_connect_nor_close(tmp_path):
    source = Blocking()
    settings = GelsightSettings.model_validate({"left": {"file": str(tmp_path)}})
    driver = TactileCamera("left", settings, time.monotonic, open_camera=lambda *_: source)
    begun_s = time.monotonic()
    with pytest.raises(FaultError, match="No picture"):
        driver.connect(0.1, threading.Event())
    assert time.monotonic() - begun_s < 120.0
    source.let_go.set()


def test_a_real_clip_goes_through_the_live_path_to_all_markers():
    settings = GelsightSettings.model_validate({"left": {"file": str(CLIP), "crop_fraction": 0.0}})
    frames = {"left": Stream("tactile_left", 256), "right": Stream("tactile_right", 256)}
    fields = {finger: Stream(finger, 256) for finger in frames}
    driver = TactileCamera(
        "left", settings, time.monotonic, frames["left"], lambda path, _: FileSource(path, 200.0)
    )
    poses, wrench = SampleStream("arm", 3, 8), SampleStream("wrench", 6, 8)
    raw = RawStreams(frames, SampleStream("force_torque", 6, 8), poses)
    live = LiveSensing(raw, fields, wrench, np.zeros(6))
    driver.connect(60.0, threading.Event())
    until(lambda: frames["left"].count >= 30)
    driver.close()
    live.update()
    tracked, _, _ = fields["left"].since(0)
    assert len(tracked) == frames["left"].count
    seen = np.mean([(field.state == MarkerState.SEEN).sum() for field in tracked])
    assert seen > 0.95 * MARKERS
    whole = {frame.sequence: frame.image for frame in islice(read_pictures(CLIP), 200)}
    for frame in frames["left"].since(0)[0]:
        assert np.array_equal(frame.image, whole[frame.sequence])
