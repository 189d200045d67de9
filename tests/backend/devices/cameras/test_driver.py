"""Camera controls by the names of older and newer kernels, against the kernel's own layout."""

import errno
import json
import struct
import sys
import threading
import time
import types
from itertools import islice, pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.backend.devices.cameras.damage import GELSIGHT, SCENES, outcomes
from tests.backend.devices.waiting import until
from tests.backend.sensing.known_truth import rest_dots
from touchdown.backend.config.hardware import GelsightSettings, HardwareSettings
from touchdown.backend.core import InputError, MarkerState, Stream, TactileFrame
from touchdown.backend.devices import DeviceState, make_tactile
from touchdown.backend.devices.cameras.sources import find_controls, lock_controls
from touchdown.backend.devices.lerobot.driver import LeRobotSource, _maker
from touchdown.backend.sensing.jpeg_damage import DamageCheckingTracker, neighbour_residual_px
from touchdown.backend.sensing.picture_files import read_pictures

NEWER = {
    "User Controls": None,
    "White Balance, Automatic": 1,
    "White Balance Temperature": 6500,
    "Camera Controls": None,
    "Auto Exposure": 3,
    "Exposure Time, Absolute": 100,
    "Exposure, Dynamic Framerate": 1,
}
OLDER = {
    "White Balance Temperature, Auto": 1,
    "White Balance Temperature": 6500,
    "Exposure, Auto": 3,
    "Exposure (Absolute)": 100,
    "Exposure, Auto Priority": 1,
}
LOCKED = {
    "white_balance_auto": 0.0,
    "exposure_auto": 1.0,
    "exposure_priority": 0.0,
    "exposure": 180.0,
    "white_balance": 4500.0,
}


class Kernel:
    """Answers as the kernel's video layer does; ``None`` marks the title of a class."""

    def __init__(self, controls, barred=()):
        self.titles = list(controls)
        self.values = dict(controls)
        self.barred = barred

    def __call__(self, file, request, content):
        (first,) = struct.unpack_from("<I", content)
        if request == 0xC0445624:  # _IOWR('V', 36, struct v4l2_queryctrl)
            assert len(content) == 68
            assert first & 0x80000000
            number = first & 0x7FFFFFFF
            if number >= len(self.titles):
                raise OSError(errno.EINVAL, "no more")
            title = self.titles[number]
            kind = 6 if self.values[title] is None else 1
            flags = 0x1 if title in self.barred else 0
            head = struct.pack("<II32s", number + 1, kind, title.encode())
            return head + struct.pack("<4iI2I", 0, 10_000, 1, 0, flags, 0, 0)
        assert len(content) == 8
        title = self.titles[first - 1]
        if request == 0xC008561C:  # _IOWR('V', 28, struct v4l2_control)
            autos = [v for t, v in self.values.items() if t in ("Auto Exposure", "Exposure, Auto")]
            if "Absolute" in title and autos not in ([], [1]):
                raise OSError(errno.EACCES, "the automatic is on")
            self.values[title] = struct.unpack("<Ii", content)[1]
            return content
        assert request == 0xC008561B  # _IOWR('V', 27, struct v4l2_control)
        return struct.pack("<Ii", first, self.values[title])


@pytest.mark.parametrize("titles", [NEWER, OLDER], ids=["newer kernel", "older kernel"])
def test_each_control_is_set_by_the_name_that_exists_and_read_back(titles, tmp_path):
    node, kernel = tmp_path / "video0", Kernel(titles)
    node.touch()
    assert lock_controls(node, GelsightSettings(), kernel) == LOCKED
    assert set(kernel.values.values()) - {None} == {0, 1, 180, 4500}


def test_a_lab_may_name_its_own_control_and_what_is_missing_is_left_out(tmp_path):
    node, kernel = tmp_path / "video0", Kernel({"Shutter": 7})
    node.touch()
    settings = GelsightSettings(control_names={"exposure": ("exposure_absolute", "shutter")})
    assert lock_controls(node, settings, kernel) == {"exposure": 180.0}


def test_what_the_camera_refuses_is_told_as_it_is(tmp_path):
    node, kernel = tmp_path / "video0", Kernel({"Auto Exposure": 3, "Exposure Time, Absolute": 100})
    node.touch()
    settings = GelsightSettings(control_names={"exposure": ("exposure_time_absolute",)})
    assert lock_controls(node, settings, kernel) == {"exposure": 100.0}


def test_a_control_that_is_switched_off_does_not_exist():
    assert find_controls(0, Kernel(NEWER, barred=("Auto Exposure",))).keys() == {
        "white_balance_automatic",
        "white_balance_temperature",
        "exposure_time_absolute",
        "exposure_dynamic_framerate",
    }


def test_what_is_no_camera_has_no_controls(tmp_path):
    plain = tmp_path / "file"
    plain.touch()
    assert lock_controls(plain, GelsightSettings()) == {}
    assert lock_controls(tmp_path / "nothing", GelsightSettings()) == {}


@pytest.mark.promise("C4")
@pytest.mark.parametrize(
    ("kind", "off"), [("1 KiB lost", 0), ("64 bytes zeroed", 2), ("one bit", 3)]
)
def test_no_marker_is_wrong_after_damage_that_decodes(kind, off):
    found = outcomes(kind, 60, seed=1)
    assert found["wrong"] == 0
    assert found["off"] <= off
    if kind == "1 KiB lost":
        assert set(found) == {"bytes"}


@pytest.mark.promise("C4")
def test_whole_pictures_of_a_gel_that_slips_pass_but_for_a_few_and_never_two_fail_in_a_row():
    tracker, refused = DamageCheckingTracker("left"), []
    for frame in islice(read_pictures(GELSIGHT / "blue_box_exp2_camera_2.avi"), 380, 450):
        field = tracker.track(as_jpeg(frame))
        refused.append(field is None)
        assert field is None or (field.state == MarkerState.SEEN).all()
    assert tracker.refused == sum(refused) <= 5
    assert not any(a and b for a, b in pairwise(refused))


@pytest.mark.promise("C4")
def test_what_two_pictures_in_a_row_show_is_believed():
    image, rest = rest_dots()
    covered = image.copy()
    cv2.circle(covered, tuple(int(v) for v in rest[31]), 14, (120, 110, 105), -1)
    tracker = DamageCheckingTracker("left")
    fields = [
        tracker.track(TactileFrame("left", k, 0.04 * k, picture, from_jpeg=True))
        for k, picture in enumerate([image] * 4 + [covered] * 3)
    ]
    assert [field is None for field in fields] == [False] * 4 + [True, False, False]
    assert fields[-1].state[31] == MarkerState.INFERRED
    assert tracker.refused == 1


def test_lamps_that_fail_and_return_leave_no_finger_blind():
    image, _ = rest_dots()
    black = np.full_like(image, 3)
    tracker = DamageCheckingTracker("left")
    fields = [
        tracker.track(TactileFrame("left", k, 0.04 * k, picture, from_jpeg=True))
        for k, picture in enumerate([black] * 3 + [image] * 4 + [black] * 3 + [image] * 4)
    ]
    assert not any(a is None and b is None for a, b in pairwise(fields))
    assert (fields[-1].state == MarkerState.SEEN).all()


@pytest.mark.promise("C4")
def test_after_a_refused_picture_it_goes_on_as_if_that_had_never_come():
    clip, at = SCENES[0]
    frames = list(islice(read_pictures(GELSIGHT / clip), at, at + 6))
    torn = frames[4].image.copy()
    torn[120:] = np.roll(torn[120:], 16, axis=1)
    with_it, without = DamageCheckingTracker("left"), DamageCheckingTracker("left")
    for k, frame in enumerate(frames):
        if k == 4:
            assert with_it.track(TactileFrame("left", k, frame.t_s, torn, from_jpeg=True)) is None
            continue
        one, other = with_it.track(as_jpeg(frame)), without.track(as_jpeg(frame))
        assert np.array_equal(one.position_px, other.position_px)
    assert (with_it.refused, without.refused) == (1, 0)


def test_pictures_that_were_no_jpeg_are_not_judged():
    image, _ = rest_dots()
    tracker = DamageCheckingTracker("left")
    for k, picture in enumerate([image] * 4 + [np.roll(image, 9, axis=1)]):
        assert tracker.track(TactileFrame("left", k, 0.04 * k, picture)) is not None


def test_an_affine_motion_leaves_no_neighbour_and_one_marker_alone_does():
    grid = np.stack(np.divmod(np.arange(63), 9)[::-1], axis=1).astype(float)
    even = grid @ np.array([[0.3, -0.1], [0.2, 0.4]]) + (3.0, -2.0)
    assert neighbour_residual_px(even).max() < 1e-9
    even[31] += (0.3, 0.4)
    assert neighbour_residual_px(even)[31] == pytest.approx(0.5)


def as_jpeg(frame):
    return TactileFrame("left", frame.sequence, frame.t_s, frame.image, from_jpeg=True)


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
