"""Cameras of LeRobot as tactile cameras: its interface by a stand-in, and by the package itself."""

import json
import sys
import threading
import time
import types
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.backend.devices.waiting import until
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.streams import Stream
from touchdown.backend.devices.factories import make_tactile
from touchdown.backend.devices.lerobot.driver import LeRobotSource, _maker
from touchdown.backend.devices.protocols import DeviceState

CLIP = Path(__file__).parents[3] / "data" / "gelsight" / "plug_3D_exp3_camera_2.avi"
BLUE, RED = 40, 200


class Camera:
    """Has what the driver uses of ``lerobot.cameras.Camera``; red is first, as there."""

    color_mode = "rgb"
    opened = 0

    def __init__(self, config):
        self.fps, self.width, self.height = config.fps, config.width, config.height
        self.is_connected, self._number = False, 0

    def connect(self, warmup=True):
        type(self).opened += 1
        self.is_connected = True

    def async_read(self, timeout_ms=200):
        if not self.is_connected:
            raise ConnectionError("not connected")
        self._number += 1
        if self._number == 30:
            raise RuntimeError("the read thread is not running")
        if self._number % 7 == 0:
            threading.Event().wait(1e-3 * timeout_ms)
            raise TimeoutError("no frame")
        threading.Event().wait(0.005)
        picture = np.full((240, 320, 3), (RED, 90, BLUE), dtype=np.uint8)
        picture[self._number % 240] = self._number
        return picture

    def disconnect(self):
        self.is_connected = False


class Config(types.SimpleNamespace):
    """Fields as given."""


@pytest.fixture
def stand_in(monkeypatch):
    """A module of this name with what the adaptor asks for."""
    utils = types.ModuleType("lerobot.cameras.utils")
    utils.make_cameras_from_configs = lambda configs: {k: Camera(c) for k, c in configs.items()}
    mine = types.ModuleType("my_cameras")
    mine.MyConfig = lambda fps=None, width=None, height=None: Config(
        fps=fps, width=width, height=height
    )
    monkeypatch.setitem(sys.modules, "lerobot.cameras.utils", utils)
    monkeypatch.setitem(sys.modules, "my_cameras", mine)
    Camera.opened = 0


def settings(**table):
    content = {"gelsight": {"driver": "lerobot", "crop_fraction": 0.0}, "lerobot": table}
    return HardwareSettings.model_validate(content)


def made(**table):
    return make_tactile("left", settings(**table), time.monotonic, Stream("left", 256))


def test_pictures_come_blue_first_and_a_lost_camera_is_taken_again(stand_in):
    camera = made(config="my_cameras:MyConfig", left='{"fps": 100, "width": 320, "height": 240}')
    camera.connect(5.0, threading.Event())
    assert camera.identity.model == "MyConfig"
    assert camera.describe()["fps"] == 100.0
    until(lambda: Camera.opened >= 2 and camera.state is DeviceState.READY)
    frame = camera.frames.newest()
    assert frame.image.shape == (240, 320, 3)
    assert np.median(frame.image, axis=(0, 1)).tolist() == [BLUE, 90, RED]
    camera.close()


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"config": "no_such:Thing"}, "touchdown.lerobot."),
        ({"config": "my_cameras:MyConfig", "left": "{"}, "as JSON"),
        ({"config": "my_cameras:MyConfig", "left": '{"lens": 3}'}, "as JSON"),
        ({"config": "my_cameras:Other"}, "as JSON"),
    ],
)
def test_what_lerobot_cannot_make_is_one_error(stand_in, table, said):
    with pytest.raises(InputError, match=said):
        made(**table)


@pytest.mark.optional
def test_its_own_camera_reads_a_clip_of_a_real_gel():
    pytest.importorskip("lerobot.cameras.opencv")
    fields = json.dumps({"index_or_path": str(CLIP), "warmup_s": 0})
    source = LeRobotSource(_maker(settings().lerobot.config, fields, "lerobot.left"))
    picture = source.read(1.0)
    source.close()
    film = cv2.VideoCapture(str(CLIP))
    shown = [film.read()[1] for _ in range(int(film.get(cv2.CAP_PROP_FRAME_COUNT)))]
    assert any(np.array_equal(picture, one) for one in shown)
